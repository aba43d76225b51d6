"""What this machine is and keeps: versions, written beside every result, and compiled programs."""

import contextlib
import importlib.metadata
import os
import platform
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import jax

import pregrasp_jax
from pregrasp_jax import io

CACHE_SWITCH = "PREGRASP_JAX_COMPILATION_CACHE"
"""Environment variable: 0 turns the compilation cache off, wherever it is."""

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


def compilation_cache_dir() -> Path | None:
    """Return where compiled programs are kept: the user's own choice for jax, or the cache folder; None if nowhere."""
    if os.environ.get(CACHE_SWITCH) == "0":
        return None
    return Path(jax.config.values["jax_compilation_cache_dir"] or io.cache_dir() / "jax")


def enable_compilation_cache() -> None:
    """Keep compiled programs in `compilation_cache_dir`."""
    folder = compilation_cache_dir()
    if folder is None:
        jax.config.update("jax_enable_compilation_cache", False)
    elif not jax.config.values["jax_compilation_cache_dir"]:
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)


@contextlib.contextmanager
def announced_compilation(say: Callable[[str], None]) -> Iterator[None]:
    """Say that a block compiles, and afterwards how long it took, so that nothing hangs in silence."""
    say("compiling ...")
    start = time.perf_counter()
    yield
    say(f"compiled in {time.perf_counter() - start:.1f} s")
