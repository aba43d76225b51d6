"""What is written beside every result: the versions that made it; and how long it took to compile."""

import contextlib
import importlib.metadata
import platform
import time
from collections.abc import Callable, Iterator

import pregrasp_jax

_PACKAGES = ("mujoco", "mujoco-mjx", "jax", "jaxlib", "flax", "optax", "numpy")
"""Packages that can change a number."""


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
