"""Which MuJoCo XLA the `mjx` engine can use; importing this refuses any other before its internals are touched.

The hull collisions call private functions of MJX, and those change between releases without notice.
"""

from importlib import metadata

SUPPORTED = ("3.17.0",)
"""Releases of mujoco-mjx with which the tests of the engine pass."""


def require(installed: str) -> None:
    """Refuse a release that the engine was not tested with.

    Raises:
        ValueError: `installed` is not in `SUPPORTED`.
    """
    if installed not in SUPPORTED:
        allowed = ", ".join(SUPPORTED)
        raise ValueError(f"physics.engine = 'mjx': mujoco-mjx {installed} is installed; allowed: {allowed}")


require(metadata.version("mujoco-mjx"))
