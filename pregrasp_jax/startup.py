"""What comes before everything that computes: is this an environment to compute in, and where are programs kept?

Call `prepare` before the first array is made, and after `processes.join`: it starts the devices.
"""

import os
from pathlib import Path

import jax
import jax.numpy as jnp

from pregrasp_jax import io

CACHE_SWITCH = "PREGRASP_JAX_COMPILATION_CACHE"
"""Environment variable: 0 turns the compilation cache off, wherever it is."""


def prepare() -> None:
    """Refuse an environment in which nothing can be computed, and keep what is compiled.

    Raises:
        ValueError: one line says what to set, or to unset.
    """
    check()
    enable_compilation_cache()


def check() -> None:
    """Refuse an environment in which nothing can be computed.

    Raises:
        ValueError: 64-bit numbers, no device of the platform that was asked for, or no place for a cache.
    """
    if jnp.result_type(float) != jnp.float32:
        raise ValueError(
            "JAX_ENABLE_X64 is on, but networks, checkpoints and published results are of 32-bit numbers; allowed is "
            "to unset it, or jax.config.update('jax_enable_x64', False) in a script"
        )
    try:
        jax.devices()
    except Exception as error:  # jax raises what it likes, even an empty AssertionError
        platforms = jax.config.values["jax_platforms"] or ""
        reason = " ".join(str(error).split()) or "it is not there, or its package is not installed"
        raise ValueError(
            f"jax finds no device of JAX_PLATFORMS = {platforms!r} ({reason}); allowed is to unset it, or cpu"
        ) from None
    io.cache_dir()


def compilation_cache_dir() -> Path | None:
    """Return where compiled programs are kept: the user's own choice for jax, or the cache folder; None if nowhere."""
    if os.environ.get(CACHE_SWITCH) == "0":
        return None
    if chosen := jax.config.values["jax_compilation_cache_dir"]:
        return Path(chosen)
    folder = io.cache_dir() / "jax"
    return folder if io.is_writable(folder) else None


def enable_compilation_cache() -> None:
    """Keep compiled programs in `compilation_cache_dir`; jax would warn of every single one that it cannot write."""
    folder = compilation_cache_dir()
    if folder is None:
        jax.config.update("jax_enable_compilation_cache", False)
    elif not jax.config.values["jax_compilation_cache_dir"]:
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
