"""Which MuJoCo XLA the `mjx` engine can use; importing this refuses any other before its internals are touched.

The hull collisions call private functions of MJX, and those change between releases without notice.
"""

import contextlib
import io
from importlib import metadata

SUPPORTED = ("3.17.0",)
"""Releases of mujoco-mjx with which the tests of the engine pass."""


def installed() -> str | None:
    """Return the release of mujoco-mjx, None if it is not installed."""
    try:
        return metadata.version("mujoco-mjx")
    except metadata.PackageNotFoundError:
        return None


def require(release: str | None) -> None:
    """Refuse a release that the engine was not tested with.

    Raises:
        ValueError: `release` is not in `SUPPORTED`.
    """
    if release not in SUPPORTED:
        found = f"mujoco-mjx {release} is installed" if release else "mujoco-mjx is not installed"
        wanted = f"allowed: {', '.join(SUPPORTED)} (pip install mujoco-mjx=={SUPPORTED[-1]})"
        raise ValueError(f"physics.engine = 'mjx': {found}; {wanted}")


require(installed())
with contextlib.redirect_stdout(io.StringIO()):  # where Warp is missing MJX prints so, into any JSON on stdout
    import mujoco.mjx  # noqa: F401
