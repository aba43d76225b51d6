"""What this machine is: versions, cores, memory, disk; written beside every result and printed by `doctor`."""

import importlib.metadata
import platform

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
