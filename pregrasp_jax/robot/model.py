"""The robot as the rest of the package meets it: specs, names, constants of the hand, and the start pose."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from pregrasp_jax.robot import description
from pregrasp_jax.robot.clearance import CLEARANCE_MARGIN, link_clearance
from pregrasp_jax.robot.description import ACTUATORS as ACTUATORS
from pregrasp_jax.robot.description import ARM_JOINTS as ARM_JOINTS
from pregrasp_jax.robot.description import FINGER_JOINTS as FINGER_JOINTS
from pregrasp_jax.robot.description import JOINTS as JOINTS
from pregrasp_jax.robot.description import load_spec as load_spec
from pregrasp_jax.robot.description import load_table_spec as load_table_spec
from pregrasp_jax.robot.kinematics import hand_inverse_kinematics
from pregrasp_jax.types import CLOSED, OPEN

PUSH_HEIGHT = 0.1
"""m above the table at which the hand pushes (DESIGN: Push)."""

START_POSE = (-0.30, 0.0, PUSH_HEIGHT, 1.0, 0.0, 0.0, 0.0)
"""Grasp point pose [7] at the start of an episode: the near side of the table, pointing +x, level."""

GRASP_OFFSET = description.grasp_offset()
"""m from the flange to the grasp point along the hand: half way from the palm to the open fingertips."""


def finger_angle(aperture: int) -> float:
    """Return the finger drive, rad, of an aperture: a limit of its joint, `CLOSED` or `OPEN`."""
    low, high = description.joint_range(FINGER_JOINTS[0])
    return float({CLOSED: low, OPEN: high}[aperture])


FINGER_CLOSED, FINGER_OPEN = finger_angle(CLOSED), finger_angle(OPEN)
"""rad. Commanding `FINGER_CLOSED` around an object saturates the actuator: it closes with constant force."""


def actuator_gains(mj_model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Return stiffness kp and damping kv of the seven `ACTUATORS`, each [7], N m/rad and N m s/rad."""
    ids = [mj_model.actuator(name).id for name in ACTUATORS]
    return mj_model.actuator_gainprm[ids, 0].copy(), np.abs(mj_model.actuator_biasprm[ids, 2])


def feed_forward(mj_model: mujoco.MjModel) -> np.ndarray:
    """Return kv / kp [7], s: the control q + (kv / kp) q_dot makes the actuators' damping act on the error only."""
    kp, kv = actuator_gains(mj_model)
    return kv / kp


def joint_qpos_ids(mj_model: mujoco.MjModel) -> np.ndarray:
    """Return the addresses [8] in qpos of `JOINTS`, the order of `PhysicsObservation.joint_pos`."""
    return np.array([mj_model.joint(name).qposadr[0] for name in JOINTS])


@functools.cache
def _home() -> np.ndarray:
    return np.asarray(_start_solution(jnp.asarray(START_POSE, jnp.float32)))


@jax.jit
def _start_solution(pose: jax.Array) -> jax.Array:
    """Choose, of the solutions [6] that keep clear of the table, the one with the smallest joint angles."""
    solutions = hand_inverse_kinematics(pose)
    clear = jax.vmap(link_clearance)(solutions) > CLEARANCE_MARGIN
    return solutions[jnp.argmin(jnp.where(clear, jnp.linalg.norm(solutions, axis=-1), jnp.inf))]


def home_joint_pos() -> np.ndarray:
    """Return the joint positions [8] at the start: arm at `START_POSE` by inverse kinematics, hand open, rad."""
    return np.append(_home(), [FINGER_OPEN, FINGER_OPEN]).astype(np.float32)


def set_home(mj_model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Put the robot at rest at the start: positions, controls, and forward kinematics of `data`."""
    home = home_joint_pos()
    data.qpos[joint_qpos_ids(mj_model)] = home
    for tip, driver in (("hand_left_tip", FINGER_JOINTS[0]), ("hand_right_tip", FINGER_JOINTS[1])):
        data.joint(tip).qpos[0] = -data.joint(driver).qpos[0]
    data.qvel[mj_model.jnt_dofadr[[mj_model.joint(name).id for name in JOINTS]]] = 0.0
    data.ctrl[[mj_model.actuator(name).id for name in ACTUATORS]] = home[:7]
    mujoco.mj_forward(mj_model, data)
