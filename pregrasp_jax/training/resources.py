"""Memory and disk that a run will need, estimated before it starts: nobody likes to run out on the second day."""

import shutil
from pathlib import Path
from typing import Any

import jax

from pregrasp_jax.checkpoint.state import KEEP

COMPRESSED = 0.25
"""Share of the observations' bytes that their chunks take on disk; 0.1 was measured on clutter."""

WORKING_MEMORY = 1e9
"""Bytes for compiled programs, the scene bank and a chunk on its way to disk (1.1e9 measured, with libraries)."""

_MEMINFO = Path("/proc/meminfo")
_CGROUP = Path("/sys/fs/cgroup")


def num_bytes(tree: Any) -> int:
    """Return the bytes of a pytree of arrays or `jax.ShapeDtypeStruct`; a PRNG key counts as 8."""
    return sum(leaf.size * getattr(leaf.dtype, "itemsize", 8) for leaf in jax.tree.leaves(tree))


def available_memory() -> int | None:
    """Return the bytes that this process may still take: of the device, of its control group, of the machine.

    Returns:
        None where nobody says.
    """
    stats = jax.local_devices()[0].memory_stats() or {}
    if "bytes_limit" in stats:
        return stats["bytes_limit"] - stats.get("bytes_in_use", 0)
    known = [free for free in (_free_of_machine(), _free_of_control_group()) if free is not None]
    return min(known, default=None)


def available_disk(path: Path) -> int:
    """Return the bytes free for `path`, which need not exist yet."""
    existing = next(parent for parent in (path.absolute(), *path.absolute().parents) if parent.exists())
    return shutil.disk_usage(existing).free


def check(state: Any, ring: Any, run_dir: Path) -> None:
    """Refuse a run that cannot fit.

    Args:
        state: shapes of everything but the ring.
        ring: shapes of the replay's observations.
        run_dir: where checkpoints will go.

    Raises:
        ValueError: too little memory or disk; one line says how much of what and which setting to change.
    """
    state_bytes, ring_bytes = num_bytes(state), num_bytes(ring)
    # A resumed ring exists on the host, leaf by leaf, while it moves to the device; a saved state twice.
    memory = 3 * state_bytes + 1.5 * ring_bytes + WORKING_MEMORY
    disk = (KEEP + 1) * state_bytes + COMPRESSED * ring_bytes
    _refuse_above("memory", memory, available_memory(), ring_bytes)
    _refuse_above(f"disk at {run_dir}", disk, available_disk(run_dir), ring_bytes)


def _refuse_above(what: str, needed: float, available: int | None, ring_bytes: int) -> None:
    if available is not None and needed > available:
        raise ValueError(
            f"the run needs about {needed / 1e9:.2f} GB of {what}, {available / 1e9:.2f} GB are free; a smaller "
            f"replay.capacity helps (its observations take {ring_bytes / 1e9:.2f} GB)"
        )


def _free_of_machine() -> int | None:
    if not _MEMINFO.exists():
        return None
    fields = dict(line.split(":", 1) for line in _MEMINFO.read_text().splitlines() if ":" in line)
    return int(fields["MemAvailable"].split()[0]) * 1024 if "MemAvailable" in fields else None


def _free_of_control_group() -> int | None:
    limit, used = _CGROUP / "memory.max", _CGROUP / "memory.current"
    if not limit.exists() or not used.exists() or not limit.read_text().strip().isdigit():
        return None
    return int(limit.read_text()) - int(used.read_text())
