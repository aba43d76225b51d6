"""The MJCF files, found and read; what the rest of the package knows about the robot comes from here.

Names in the compiled model: joints `ARM_JOINTS`, `FINGER_JOINTS` and two tips that mirror the fingers;
actuators `ACTUATORS`; site ``grasp_point``; camera ``overhead``; plane ``table``.
"""

import functools
from pathlib import Path

import mujoco
import numpy as np

ARM_JOINTS = tuple(f"arm_{i}" for i in range(6))
FINGER_JOINTS = ("hand_left_driver", "hand_right_driver")
JOINTS = (*ARM_JOINTS, *FINGER_JOINTS)
"""The eight joints of `PhysicsObservation.joint_pos`, in its order."""

ACTUATORS = (*ARM_JOINTS, "hand_fingers")
"""The seven controls, rad: six arm joints and the drive of both fingers."""

BASE_BODY = "base"
HAND_BODY = PALM_GEOM = "hand_palm"


def mjcf_dir() -> Path:
    """Return the folder of the MJCF files: inside an installed package, or beside it in a source checkout.

    Raises:
        FileNotFoundError: neither place holds scene.xml.
    """
    package = Path(__file__).resolve().parents[1]
    places = (package / "mjcf", package.parent / "mjcf")
    for place in places:
        if (place / "scene.xml").is_file():
            return place
    raise FileNotFoundError(f"scene.xml is missing; looked in {places[0]} and {places[1]}")


def load_spec() -> mujoco.MjSpec:
    """Return robot, table and camera as a fresh spec, to which objects can be appended."""
    return mujoco.MjSpec.from_file(str(mjcf_dir() / "scene.xml"))


def load_table_spec() -> mujoco.MjSpec:
    """Return the table alone, with the solver options of the full scene."""
    return mujoco.MjSpec.from_file(str(mjcf_dir() / "table.xml"))


@functools.cache
def robot_model() -> mujoco.MjModel:
    """Return the compiled scene without objects; read it, do not change it."""
    return load_spec().compile()


def joint_range(name: str) -> np.ndarray:
    """Return the limits [2] of a joint, rad."""
    return robot_model().joint(name).range.copy()


def dh_parameters() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the Denavit-Hartenberg a, d (m) and alpha (rad) of the six joints, each [6].

    In the MJCF the link after joint i sits at (a_i, 0, d_i), turned by alpha_i about x; the last is the flange.
    """
    mj_model = robot_model()
    bodies = [int(mj_model.joint(name).bodyid[0]) for name in ARM_JOINTS]
    flange = mj_model.site("flange")
    positions = np.stack([*mj_model.body_pos[bodies[1:]], flange.pos])
    quats = np.stack([*mj_model.body_quat[bodies[1:]], flange.quat])
    return positions[:, 0], positions[:, 2], 2 * np.arctan2(quats[:, 1], quats[:, 0])


def pose_to_matrix(pos: np.ndarray, quat: np.ndarray) -> np.ndarray:
    """Return the 4 x 4 matrix of a position and a wxyz quaternion, in float64."""
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, np.asarray(quat, np.float64) / np.linalg.norm(quat))
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation.reshape(3, 3), pos
    return matrix


def world_from_base() -> np.ndarray:
    """Return T_world_base [4, 4]."""
    base = robot_model().body(BASE_BODY)
    return pose_to_matrix(base.pos, base.quat)


def flange_from_grasp_point() -> np.ndarray:
    """Return T_flange_grasp [4, 4]: x forward out of the flange, z up where the hand is level."""
    site, flange = robot_model().site("grasp_point"), robot_model().site("flange")
    wrist_from_flange = pose_to_matrix(flange.pos, flange.quat)
    return np.linalg.inv(wrist_from_flange) @ pose_to_matrix(site.pos, site.quat)


def grasp_offset() -> float:
    """Return the distance from the flange to the grasp point along the hand, m."""
    return float(flange_from_grasp_point()[2, 3])
