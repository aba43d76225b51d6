"""The MJCF of the UR5e with the RG2, found and read; every number of this robot comes from there.

Names in the compiled model: joints `ARM_JOINTS`, `FINGER_JOINTS` and two tips that mirror the fingers; actuators
`ACTUATORS`; site ``grasp_point``.
"""

import functools

import mujoco
import numpy as np

from pregrasp_jax import io
from pregrasp_jax.robot.kinematics import Arm
from pregrasp_jax.robot.links import pose_to_matrix

ARM_JOINTS = tuple(f"arm_{i}" for i in range(6))
FINGER_JOINTS = ("hand_left_driver", "hand_right_driver")
JOINTS = (*ARM_JOINTS, *FINGER_JOINTS)
"""The eight joints of `PhysicsObservation.joint_pos`, in its order."""

ACTUATORS = (*ARM_JOINTS, "hand_fingers")
"""The seven controls, rad: six arm joints and the drive of both fingers."""

MAX_JOINT_SPEED = 3.14
"""rad/s, 180 degrees per second for every joint (UR5e data sheet)."""

BASE_BODY = "base"
HAND_BODY = PALM_GEOM = "hand_palm"


def attach(spec: mujoco.MjSpec) -> None:
    """Add the robot to a scene."""
    robot = mujoco.MjSpec.from_file(str(io.mjcf_dir() / "ur5e.xml"))
    spec.worldbody.add_frame().attach_body(robot.body(BASE_BODY), "", "")


@functools.cache
def robot_model() -> mujoco.MjModel:
    """Return the compiled robot without a scene; read it, do not change it."""
    return mujoco.MjSpec.from_file(str(io.mjcf_dir() / "ur5e.xml")).compile()


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


@functools.cache
def arm() -> Arm:
    """Return the arm with its hand."""
    a, d, alpha = dh_parameters()
    return Arm(
        a=a,
        d=d,
        alpha=alpha,
        world_from_base=world_from_base(),
        flange_from_hand=flange_from_grasp_point(),
        limits=np.stack([joint_range(name) for name in ARM_JOINTS]),
        max_speed=MAX_JOINT_SPEED,
    )


def world_from_base() -> np.ndarray:
    """Return T_world_base [4, 4]."""
    base = robot_model().body(BASE_BODY)
    return pose_to_matrix(base.pos, base.quat)


def flange_from_grasp_point() -> np.ndarray:
    """Return T_flange_grasp [4, 4]: x forward out of the flange, z up where the hand is level."""
    site, flange = robot_model().site("grasp_point"), robot_model().site("flange")
    wrist_from_flange = pose_to_matrix(flange.pos, flange.quat)
    return np.linalg.inv(wrist_from_flange) @ pose_to_matrix(site.pos, site.quat)


def palm_to_grasp_point() -> float:
    """Return the distance from the palm to the grasp point along the hand, m."""
    palm = robot_model().geom(PALM_GEOM)
    return float(flange_from_grasp_point()[2, 3] - palm.pos[0] - palm.size[0])


def feed_forward() -> np.ndarray:
    """Return kv / kp [7], s: the control q + (kv / kp) q_dot makes the actuators' damping act on the error only."""
    mj_model = robot_model()
    ids = [mj_model.actuator(name).id for name in ACTUATORS]
    return np.abs(mj_model.actuator_biasprm[ids, 2]) / mj_model.actuator_gainprm[ids, 0]
