"""What is written beside every result, the versions that made it; how long it took to compile; and free memory."""

import contextlib
import importlib.metadata
import platform
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pregrasp_jax

_PACKAGES = ("mujoco", "mujoco-mjx", "jax", "jaxlib", "flax", "optax", "numpy")
"""Packages that can change a number."""

_MEMINFO = Path("/proc/meminfo")
_CGROUP = Path("/sys/fs/cgroup")


def versions() -> dict[str, str]:
    """Return the versions of Python and of every package that can change a result; "absent" if not installed."""
    found = {"python": platform.python_version(), "pregrasp_jax": pregrasp_jax.__version__}
    for package in _PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "absent"
    return found


@contextlib.contextmanager
def announced_compilation(say: Callable[[str], None]) -> Iterator[None]:
    """Say that a block compiles, and afterwards how long it took, so that nothing hangs in silence."""
    say("compiling ...")
    start = time.perf_counter()
    yield
    say(f"compiled in {time.perf_counter() - start:.1f} s")


def free_memory() -> int | None:
    """Return the bytes that a new process may take, of its control group and of the machine; None if nobody says."""
    known = [free for free in (_free_of_machine(), _free_of_control_group()) if free is not None]
    return min(known, default=None)


def _free_of_machine() -> int | None:
    if not _MEMINFO.exists():
        return None
    fields = dict(line.split(":", 1) for line in _MEMINFO.read_text().splitlines() if ":" in line)
    return int(fields["MemAvailable"].split()[0]) * 1024 if "MemAvailable" in fields else None


def _free_of_control_group() -> int | None:
    limit, used = _CGROUP / "memory.max", _CGROUP / "memory.current"
    if not limit.exists() or not used.exists() or not limit.read_text().strip().isdigit():
        return None
    return int(limit.read_text()) - int(used.read_text()) + _inactive_file_cache()


def _inactive_file_cache() -> int:
    """Return the bytes that count as used by the control group, but are given back when they are in the way."""
    stat = _CGROUP / "memory.stat"
    rows = (line.split() for line in stat.read_text().splitlines()) if stat.exists() else ()
    return next((int(row[1]) for row in rows if row[0] == "inactive_file"), 0)
