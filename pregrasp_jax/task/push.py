"""The paper's push: a straight line at constant height, to any cell of the half ring ahead, open or closed.

`straight_pushes` makes such pushes for any other choices of how the hand is held.
"""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp

from pregrasp_jax.config import TaskConfig
from pregrasp_jax.robot.base import Robot
from pregrasp_jax.spaces import grid, motion
from pregrasp_jax.spaces.actions import ActionSpace, Choice
from pregrasp_jax.spaces.motion import APERTURE_TIME, SETTLE_TIME, TURN_SPEED
from pregrasp_jax.spaces.workspace import Workspace
from pregrasp_jax.task.primitive import Plan, Primitive, Stroke, follow
from pregrasp_jax.types import CTRL_DT, HandPose


def make_push(robot: Robot, workspace: Workspace, task: TaskConfig, *, max_distance: float) -> Primitive:
    """Return pushes with the hand held as at the start, closed (choice 0) or open (choice 1).

    Args:
        robot: who pushes.
        workspace: where.
        task: radii of the half ring and speed.
        max_distance: m, longest push that is planned; a longer one is refused.
    """
    actions = push_actions(robot)

    def mask(hand: HandPose) -> jax.Array:
        ring = grid.half_ring(hand.xy, r_in=task.r_in, r_out=task.r_out, yaw=hand.yaw, full=task.full_ring)
        return jnp.broadcast_to(ring[..., None], actions.shape)

    return straight_pushes("push", actions, mask, robot, workspace, task, max_distance=max_distance)


def straight_pushes(
    name: str,
    actions: ActionSpace,
    mask: Callable[[HandPose], jax.Array],
    robot: Robot,
    workspace: Workspace,
    task: TaskConfig,
    *,
    max_distance: float,
) -> Primitive:
    """Return straight lines from where the hand is to a cell, held as the choice says.

    Args:
        name: as in `TaskConfig.primitive`.
        actions: choices of height, heading and aperture; they change on the way.
        mask: (hand) -> [H, W, K] bool, which actions are allowed next.
        robot: who pushes.
        workspace: where.
        task: speed.
        max_distance: m, longest push that is planned; a longer one is refused.
    """
    turns = len({choice.yaw for choice in actions.choices}) > 1
    num_rows = num_push_rows(max_distance, task.push_speed, max_turn=math.pi if turns else 0.0)

    def decode(hand: HandPose, action: jax.Array) -> Stroke:
        xy, choice = actions.decode(action)
        z, yaw, aperture = actions.held(choice)
        return Stroke(start=hand, end=HandPose(xy, z, yaw, aperture))

    def plan(joint_pos: jax.Array, stroke: Stroke) -> Plan:
        return plan_push(robot, workspace, joint_pos, stroke, push_speed=task.push_speed, num_rows=num_rows)

    return Primitive(name=name, actions=actions, mask=mask, decode=decode, plan=plan)


def push_actions(robot: Robot) -> ActionSpace:
    """Return the two choices of a push; the mirror image of either is itself."""
    z, yaw = float(robot.start.z), float(robot.start.yaw)
    apertures = {"closed": robot.grasp_aperture, "open": float(robot.start.aperture)}
    choices = tuple(Choice(name=name, z=z, yaw=yaw, aperture=angle) for name, angle in apertures.items())
    return ActionSpace(choices, mirrored=(0, 1))


def _held(hand: HandPose) -> motion.Held:
    return motion.Held(hand.xy, hand.z, hand.yaw, hand.aperture)


def num_push_rows(max_distance: float, push_speed: float, *, max_turn: float = 0.0) -> int:
    """Return the static number of control rows T that a push of at most `max_distance` m and `max_turn` rad needs."""
    duration = max(max_distance / push_speed, max_turn / TURN_SPEED)
    return math.ceil((APERTURE_TIME + duration + SETTLE_TIME) / CTRL_DT) + 1


def plan_push(
    robot: Robot,
    workspace: Workspace,
    joint_pos: jax.Array,
    stroke: Stroke,
    *,
    push_speed: float,
    num_rows: int,
) -> Plan:
    """Plan a straight push: change the aperture if it differs, move and turn, stand still.

    Args:
        robot: who pushes.
        workspace: where.
        joint_pos: [J] where the joints are now.
        stroke: from where, where to, and how the hand is held.
        push_speed: m/s, mean speed of the minimum-jerk profile.
        num_rows: static number of rows T, from `num_push_rows`.
    """
    start, end = stroke.start, stroke.end
    times = CTRL_DT * jnp.arange(num_rows)
    line = motion.straight_line(_held(start), _held(end), times, push_speed=push_speed, shortest=CTRL_DT)
    path, seconds = HandPose(line.xy, line.z, line.yaw, line.aperture), line.seconds
    num_ctrl = jnp.ceil(seconds / CTRL_DT - 1e-3).astype(jnp.int32)
    return follow(robot, workspace, joint_pos, path, num_ctrl=num_ctrl, seconds=seconds, hand=end)
