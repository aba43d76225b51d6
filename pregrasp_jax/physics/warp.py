"""The `warp` engine, MJX-Warp: what it would need, and which of that is missing here.

A scene needs meshes of its own. MuJoCo Warp can give them to it, MJX-Warp of the supported releases cannot: all scenes
get the meshes of the first. Until one can, this engine says so, instead of simulating other objects than were asked.
"""

import importlib.util

import jax

from pregrasp_jax.physics import mjx_version

_OTHERS = "allowed here: native, mjx"


def make_engine() -> None:
    """Refuse, in one line that names what is missing first.

    Raises:
        ValueError: always, with the supported releases of MJX.
    """
    mjx_version.require(mjx_version.installed())
    if importlib.util.find_spec("warp") is None:
        raise ValueError(
            "physics.engine = 'warp' needs warp-lang: pip install 'pregrasp_jax[warp]', an NVIDIA GPU, and an MJX-Warp "
            f"with meshes per scene, which mujoco-mjx {mjx_version.installed()} does not have; {_OTHERS}"
        )
    platforms = sorted({device.platform for device in jax.devices()})
    if "gpu" not in platforms:
        raise ValueError(
            f"physics.engine = 'warp' needs an NVIDIA GPU, and jax sees only {', '.join(platforms)}: "
            f"pip install 'jax[cuda12]' where there is one; {_OTHERS}"
        )
    raise ValueError(
        f"physics.engine = 'warp': MJX-Warp of mujoco-mjx {mjx_version.installed()} cannot give every scene its own "
        f"meshes; {_OTHERS}"
    )
