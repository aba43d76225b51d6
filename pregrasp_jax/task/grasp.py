"""The grasp that ends an evaluated episode (Sec. IV-A): close with constant force, lift, hold."""

import jax
import jax.numpy as jnp

from pregrasp_jax.robot.base import Robot
from pregrasp_jax.robot.closing_region import scene_coverage
from pregrasp_jax.spaces.motion import minimum_jerk
from pregrasp_jax.spaces.workspace import Workspace
from pregrasp_jax.task.primitive import Plan, follow
from pregrasp_jax.types import CTRL_DT, EnvState, GraspResult, HandPose, HullBank, PhysicsObservation

LIFT_HEIGHT, LIFT_SPEED = 0.2, 0.1
"""m and m/s, after the fingers have closed (Sec. IV-A)."""

CLOSE_TIME, HOLD_TIME = 1.0, 5.0
"""s of closing with constant force, and of holding after the lift."""

TRIAL_HOLD = 0.3
"""s of holding where a grasp is only tried: what slips does so while it is lifted."""

_MIN_LIFT = 0.15
"""m; a held object may slip by a quarter of the lift, no more."""


def plan_grasp(robot: Robot, workspace: Workspace, state: EnvState, *, hold: float = HOLD_TIME) -> Plan:
    """Return the motion of a grasp where the hand is now, which ends with holding for `hold` s.

    Walls are kept clear of with the fingers as they are: closed ones reach 34 mm farther ahead, but not with a target
    between them.
    """
    seconds = CLOSE_TIME + LIFT_HEIGHT / LIFT_SPEED + hold
    times = CTRL_DT * jnp.arange(round(seconds / CTRL_DT))
    lift = LIFT_HEIGHT * minimum_jerk((times - CLOSE_TIME) / (LIFT_HEIGHT / LIFT_SPEED))
    hand, blank = state.hand, jnp.zeros(len(times))
    path = HandPose(
        xy=jnp.broadcast_to(hand.xy, (len(times), 2)),
        z=hand.z + lift,
        yaw=hand.yaw + blank,
        aperture=robot.grasp_aperture + blank,
    )
    num_ctrl = jnp.int32(len(times))
    joint_pos = state.physics_obs.joint_pos
    length = {"num_ctrl": num_ctrl, "seconds": jnp.float32(seconds)}
    return follow(robot, workspace, joint_pos, path, **length, hand=hand, opening=hand.aperture + blank)


def judge_grasp(robot: Robot, bank: HullBank, before: EnvState, plan: Plan, after: PhysicsObservation) -> GraspResult:
    """Return whether the target was lifted and is still between the fingers."""
    held = held_objects(robot, bank, before, after)[before.scene.target]
    return GraspResult(held, after.diverged, after.overflows, plan.obstruction)


def held_objects(robot: Robot, bank: HullBank, before: EnvState, after: PhysicsObservation) -> jax.Array:
    """Return which objects [MAX_OBJECTS] bool a grasp has lifted and holds between the fingers."""
    rise = after.object_poses[:, 2] - before.physics_obs.object_poses[:, 2]
    assert robot.closing_region is not None, f"robot {robot.name} has no closing region"
    region = robot.closing_region(before.hand.aperture)
    coverage = scene_coverage(bank, before.scene.object_ids, after.object_poses, after.hand_pose, region)
    return (rise > _MIN_LIFT) & (coverage > 0) & ~after.diverged
