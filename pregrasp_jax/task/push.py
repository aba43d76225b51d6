"""The paper's push: a straight line at constant height, to any cell of the half ring ahead, open or closed."""

import math

import jax
import jax.numpy as jnp

from pregrasp_jax.config import TaskConfig
from pregrasp_jax.robot.base import Robot
from pregrasp_jax.spaces import grid
from pregrasp_jax.spaces.actions import ActionSpace, Choice
from pregrasp_jax.spaces.workspace import Workspace
from pregrasp_jax.task.primitive import Plan, Primitive, Stroke, follow, minimum_jerk
from pregrasp_jax.types import CTRL_DT, HandPose

SETTLE_TIME = 0.25
"""s of standing still after a push."""

APERTURE_TIME = 0.5
"""s for the fingers to open or close before a push that changes the aperture."""


def make_push(robot: Robot, workspace: Workspace, task: TaskConfig, *, max_distance: float) -> Primitive:
    """Return pushes with the hand held as at the start, closed (choice 0) or open (choice 1).

    Args:
        robot: who pushes.
        workspace: where.
        task: radii of the half ring and speed.
        max_distance: m, longest push that is planned; a longer one is refused.
    """
    actions = push_actions(robot)
    num_rows = num_push_rows(max_distance, task.push_speed)

    def mask(hand: HandPose) -> jax.Array:
        ring = grid.half_ring(hand.xy, r_in=task.r_in, r_out=task.r_out, yaw=hand.yaw, full=task.full_ring)
        return jnp.broadcast_to(ring[..., None], actions.shape)

    def decode(hand: HandPose, action: jax.Array) -> Stroke:
        xy, choice = actions.decode(action)
        z, yaw, aperture = actions.held(choice)
        return Stroke(start=hand, end=HandPose(xy, z, yaw, aperture))

    def plan(joint_pos: jax.Array, stroke: Stroke) -> Plan:
        return plan_push(robot, workspace, joint_pos, stroke, push_speed=task.push_speed, num_rows=num_rows)

    return Primitive(name="push", actions=actions, mask=mask, decode=decode, plan=plan)


def push_actions(robot: Robot) -> ActionSpace:
    """Return the two choices of a push; the mirror image of either is itself."""
    z, yaw = float(robot.start.z), float(robot.start.yaw)
    apertures = {"closed": robot.grasp_aperture, "open": float(robot.start.aperture)}
    choices = tuple(Choice(name=name, z=z, yaw=yaw, aperture=angle) for name, angle in apertures.items())
    return ActionSpace(choices, mirrored=(0, 1))


def num_push_rows(max_distance: float, push_speed: float) -> int:
    """Return the static number of control rows T that a push of at most `max_distance` m needs."""
    return math.ceil((APERTURE_TIME + max_distance / push_speed + SETTLE_TIME) / CTRL_DT) + 1


def plan_push(
    robot: Robot,
    workspace: Workspace,
    joint_pos: jax.Array,
    stroke: Stroke,
    *,
    push_speed: float,
    num_rows: int,
) -> Plan:
    """Plan a straight push: change the aperture if it differs, move, stand still.

    Args:
        robot: who pushes.
        workspace: where.
        joint_pos: [J] where the joints are now.
        stroke: from where, where to, and how the hand is held.
        push_speed: m/s, mean speed of the minimum-jerk profile.
        num_rows: static number of rows T, from `num_push_rows`.
    """
    start, end = stroke.start, stroke.end
    distance = jnp.linalg.norm(end.xy - start.xy)
    wait = jnp.where(jnp.abs(end.aperture - start.aperture) < 1e-6, 0.0, APERTURE_TIME)
    duration = jnp.maximum(distance / push_speed, CTRL_DT)
    time = CTRL_DT * jnp.arange(num_rows)
    share = minimum_jerk((time - wait) / duration)
    turn = jnp.mod(end.yaw - start.yaw + jnp.pi, 2 * jnp.pi) - jnp.pi
    path = HandPose(
        xy=start.xy[None] + share[:, None] * (end.xy - start.xy)[None],
        z=start.z + share * (end.z - start.z),
        yaw=start.yaw + share * turn,
        aperture=start.aperture + minimum_jerk(time / APERTURE_TIME) * (end.aperture - start.aperture),
    )
    seconds = wait + duration + SETTLE_TIME
    num_ctrl = jnp.ceil(seconds / CTRL_DT - 1e-3).astype(jnp.int32)
    return follow(robot, workspace, joint_pos, path, num_ctrl=num_ctrl, seconds=seconds, hand=end)
