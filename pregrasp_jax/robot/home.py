"""Where an episode starts, and what the controls mean there; commands of the hand."""

import functools

import jax.numpy as jnp
import mujoco
import numpy as np

from pregrasp_jax.robot import description, kinematics

PUSH_HEIGHT = 0.1
"""m; the lowest height at which the hand moves freely above the table (Sec. III-C)."""

START = (-0.30, 0.0, PUSH_HEIGHT)
"""m; grasp point at the start of an episode, hand level and pointing along +x."""

_ELBOW_UP = (0.0, -1.6, 2.0, -0.4, 1.5, 0.0)
"""rad; the start takes the solution nearest to this posture, which keeps the elbow above the table."""

FINGER_CLOSED, FINGER_OPEN = (float(x) for x in description.joint_range(description.FINGER_JOINTS[0]))
"""rad; commands of the finger drive. Closing on an object saturates the drive: constant force."""


@functools.cache
def home_joints() -> np.ndarray:
    """Return the arm joints [6] rad at `START`, solved in closed form.

    Raises:
        ValueError: the start pose is out of the robot's reach.
    """
    solutions = kinematics.hand_inverse_kinematics(jnp.array([*START, 1.0, 0.0, 0.0, 0.0]))
    joints = np.asarray(kinematics.nearest_solution(solutions, jnp.array(_ELBOW_UP)), np.float64)
    if np.isnan(joints).any():
        raise ValueError(f"start pose {START} is out of reach of the robot at {description.world_from_base()[:3, 3]}")
    return joints


def home_ctrl() -> np.ndarray:
    """Return the controls [7] rad that hold the arm at `home_joints` with the hand open."""
    return np.append(home_joints(), FINGER_OPEN)


def set_home(mj_model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Put the robot of any model that contains it at the start, at rest, fingers open and mimic joints with them."""
    data.qpos[joint_qpos_ids(mj_model)] = [*home_joints(), FINGER_OPEN, FINGER_OPEN]
    for follower, leader, ratio in _mimics(mj_model):
        data.qpos[follower] = ratio * data.qpos[leader]
    data.ctrl[[mj_model.actuator(name).id for name in description.ACTUATORS]] = home_ctrl()


def joint_qpos_ids(mj_model: mujoco.MjModel) -> np.ndarray:
    """Return the indices [8] into qpos of `description.JOINTS`."""
    return np.array([mj_model.jnt_qposadr[mj_model.joint(name).id] for name in description.JOINTS])


@functools.cache
def feed_forward() -> np.ndarray:
    """Return kv / kp [6] s of the arm's actuators: the lead that cancels their damping at constant speed."""
    mj_model = description.robot_model()
    ids = [mj_model.actuator(name).id for name in description.ARM_JOINTS]
    return mj_model.actuator_biasprm[ids, 2] / mj_model.actuator_biasprm[ids, 1]


def _mimics(mj_model: mujoco.MjModel) -> list[tuple[int, int, float]]:
    joints = [i for i in range(mj_model.neq) if mj_model.eq_type[i] == mujoco.mjtEq.mjEQ_JOINT]
    follower, leader = (mj_model.jnt_qposadr[ids[joints]] for ids in (mj_model.eq_obj1id, mj_model.eq_obj2id))
    return list(zip(follower, leader, mj_model.eq_data[joints, 1], strict=True))
