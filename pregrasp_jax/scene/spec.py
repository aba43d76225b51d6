"""What stands around the objects: table, camera, walls of the workspace, and a robot."""

import functools
import warnings

import mujoco
import numpy as np

from pregrasp_jax import io
from pregrasp_jax.robot.base import Robot
from pregrasp_jax.spaces.workspace import Workspace

_WALL = {"contype": 0, "conaffinity": 3, "friction": [0.3, 0.005, 0.0001], "rgba": [0.72, 0.7, 0.66, 1]}
"""Like the table, a wall collides with the robot and with objects; its friction is that of the arm's shell."""


def table_spec(workspace: Workspace) -> mujoco.MjSpec:
    """Return the table with the walls of a place, and the solver options of every scene."""
    spec = mujoco.MjSpec.from_file(str(io.mjcf_dir() / "table.xml"))
    for index, wall in enumerate(workspace.walls):
        spec.worldbody.add_geom(
            name=f"wall_{index}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=wall.center,
            size=wall.half_size,
            quat=[np.cos(wall.yaw / 2), 0.0, 0.0, np.sin(wall.yaw / 2)],
            **_WALL,
        )
    return spec


def scene_spec(robot: Robot, workspace: Workspace) -> mujoco.MjSpec:
    """Return a robot at its table, to which objects can be appended; it comes before them."""
    mujoco.set_mju_user_warning(lambda _: None)  # see `scene.model.silence_warnings`; also of what is attached here
    spec = table_spec(workspace)
    robot.attach(spec)
    return spec


def compile_spec(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile a spec to which something was attached by its own names, which MuJoCo warns of."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Attaching a spec with an empty prefix")
        return spec.compile()


@functools.cache
def table_model() -> mujoco.MjModel:
    """Return the compiled table with the camera ``overhead``; read it, do not change it."""
    return mujoco.MjSpec.from_file(str(io.mjcf_dir() / "table.xml")).compile()
