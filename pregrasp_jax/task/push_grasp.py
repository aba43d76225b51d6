"""PPG's push-grasp: the hand comes down, pushes straight ahead, closes and lifts; what it holds is carried away.

An action is where the hand comes down, its heading and its aperture: a `PushGrasp`, or a flat index of Q[row, col,
heading], whose aperture is the middle of the range. After every stroke the hand is at home and out of the picture.

Source: Kiatos et al., "Learning Push-Grasping in Dense Clutter" (RA-L 2022), as its published code does it; the times
are those of a faster hand (docs/baselines.md).
"""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pregrasp_jax.config import TaskConfig
from pregrasp_jax.physics import strokes
from pregrasp_jax.physics.base import Engine
from pregrasp_jax.physics.strokes import Legs
from pregrasp_jax.robot.base import Robot
from pregrasp_jax.spaces.actions import ActionSpace, Bound, Choice
from pregrasp_jax.spaces.motion import minimum_jerk
from pregrasp_jax.spaces.workspace import Workspace
from pregrasp_jax.task.primitive import Plan, Primitive, Stroke, follow
from pregrasp_jax.types import CTRL_DT, HandPose, HullBank

HEADINGS = 16
"""Directions of a stroke, 22.5 degrees apart."""

HEIGHT, DISTANCE = 0.1, 0.15
"""m, of a stroke above the table, and its length."""

APERTURE = Bound(name="aperture", low=0.6, high=1.1, unit="rad")
"""What a policy chooses beside the index."""

CLEARANCE = 0.3
"""m above a stroke from which the hand comes down, clear of every object."""

DESCENT_TIME, CLOSE_TIME, CLOSING_TIME = 1.0, 1.0, 0.75
"""s; for closing, in all and of moving."""

LIFT_HEIGHT, LIFT_SPEED, TRAVEL_SPEED = 0.3, 0.2, 0.2
"""m and m/s; the last on the way from home and back, which takes time but is not simulated."""

HOLD_TIME = 5.0
"""s of holding after the lift (Sec. IV-A of the paper that this package implements)."""

LIFTED, TILTED = 0.2, 0.3
"""m above the table and rad; an object beyond either is taken away, as one off the table is."""

_SUNK = 0.02
"""m that an object may be below the table before it counts as fallen off."""


class PushGrasp(Stroke):
    """A stroke.

    Attributes:
        start: where the hand comes down, and how it is held.
        end: where it closes.
        final: () bool, it is meant to take the target; an obstacle in the hand is a failure then.
    """

    final: jax.Array


def push_grasp(xy: Any, yaw: Any, aperture: Any, *, distance: Any = DISTANCE, final: Any = False) -> PushGrasp:
    """Return the stroke that begins at `xy` [2] m with heading `yaw` () and aperture () rad, `distance` () m long.

    Raises:
        ValueError: the aperture is a plain number out of range.
    """
    if isinstance(aperture, int | float):
        APERTURE.refuse(aperture)
    xy = jnp.asarray(xy, jnp.float32)
    z, yaw, aperture = (jnp.asarray(value, jnp.float32) for value in (HEIGHT, yaw, aperture))
    ahead = distance * jnp.stack([jnp.cos(yaw), jnp.sin(yaw)])
    return PushGrasp(HandPose(xy, z, yaw, aperture), HandPose(xy + ahead, z, yaw, aperture), jnp.asarray(final, bool))


def stroke_actions() -> ActionSpace:
    """Return every cell with every heading; the aperture is free."""
    yaws = 2 * math.pi / HEADINGS * np.arange(HEADINGS)
    middle = (APERTURE.low + APERTURE.high) / 2
    choices = [Choice(name=f"{np.degrees(yaw):g} deg", z=HEIGHT, yaw=float(yaw), aperture=middle) for yaw in yaws]
    return ActionSpace(tuple(choices), mirrored=tuple(-k % HEADINGS for k in range(HEADINGS)), free=(APERTURE,))


def make_push_grasp(
    robot: Robot, workspace: Workspace, task: TaskConfig, *, max_distance: float, hold_time: float = HOLD_TIME
) -> Primitive:
    """Return the primitive.

    Args:
        robot: a hand that floats.
        workspace: where.
        task: speed.
        max_distance: unused, strokes have their own length.
        hold_time: s of holding after the lift.
    """
    del max_distance
    actions = stroke_actions()

    def normal(action: Any) -> PushGrasp:
        if isinstance(action, PushGrasp):
            return action
        xy, choice = actions.decode(action)
        _, yaw, aperture = actions.held(choice)
        return push_grasp(xy, yaw, aperture)

    def plan(joint_pos: jax.Array, stroke: PushGrasp) -> Plan:
        del joint_pos  # the hand is put where the stroke begins
        return plan_stroke(robot, workspace, stroke, push_speed=task.push_speed, hold_time=hold_time)

    return Primitive(
        name="push_grasp",
        actions=actions,
        mask=lambda hand: jnp.ones(actions.shape, bool),
        decode=lambda hand, action: normal(action),
        plan=plan,
        normal=normal,
        motions=2,  # a stroke and the way back
        choice_of=lambda stroke: jnp.round(stroke.start.yaw * HEADINGS / (2 * jnp.pi)).astype(jnp.int32) % HEADINGS,
    )


def plan_stroke(robot: Robot, workspace: Workspace, stroke: PushGrasp, *, push_speed: float, hold_time: float) -> Plan:
    """Plan a stroke: down, ahead, close, up, hold.

    Args:
        robot: who moves.
        workspace: what must be kept clear of.
        stroke: at most `DISTANCE` long; a shorter one stands still for the rest of its time.
        push_speed: m/s, mean speed of the minimum-jerk push.
        hold_time: s.
    """
    durations = DESCENT_TIME, DISTANCE / push_speed, CLOSE_TIME + LIFT_HEIGHT / LIFT_SPEED + hold_time
    down, pushed, rows = (round(time / CTRL_DT) for time in np.cumsum(durations))
    start, end = stroke.start, stroke.end
    time = CTRL_DT * jnp.arange(rows)
    distance = jnp.linalg.norm(end.xy - start.xy)
    descent = minimum_jerk(time / DESCENT_TIME)
    ahead = minimum_jerk((time - down * CTRL_DT) / jnp.maximum(distance / push_speed, CTRL_DT))
    closing = minimum_jerk((time - pushed * CTRL_DT) / CLOSING_TIME)
    lift = minimum_jerk((time - pushed * CTRL_DT - CLOSE_TIME) / (LIFT_HEIGHT / LIFT_SPEED))
    path = HandPose(
        xy=start.xy[None] + ahead[:, None] * (end.xy - start.xy)[None],
        z=start.z + CLEARANCE * (1 - descent) + LIFT_HEIGHT * lift,
        yaw=start.yaw + jnp.zeros(rows),
        aperture=start.aperture + closing * (robot.grasp_aperture - start.aperture),
    )
    home = jax.tree.map(jnp.asarray, robot.start)
    travel = jnp.linalg.norm(start.xy - home.xy) + jnp.linalg.norm(end.xy - home.xy)
    seconds = rows * CTRL_DT + travel / TRAVEL_SPEED
    joint_pos = jnp.asarray(robot.home).at[3].set(start.yaw)
    plan = follow(robot, workspace, joint_pos, path, num_ctrl=jnp.int32(rows), seconds=jnp.float32(seconds), hand=home)
    return plan.replace(ctrl=Legs(plan.ctrl, (down, pushed)), stroke=stroke)


def make_engine(bank: HullBank, robot: Robot, workspace: Workspace, *, threads: int = 0) -> Engine:
    """Return the `native` engine of strokes; see `physics.strokes`."""
    gone = functools.partial(taken_away, workspace=workspace)
    return strokes.make_engine(bank, robot, workspace, gone=gone, threads=threads)


def taken_away(poses: Any, *, workspace: Workspace) -> Any:
    """Return which objects [...] bool at poses [..., 7] m are taken away after a stroke: lifted, fallen, or off."""
    return (poses[..., 2] > LIFTED) | tilted(poses) | has_left(poses, workspace)


def has_left(poses: Any, workspace: Workspace) -> Any:
    """Return which objects [...] bool at poses [..., 7] are off the table; their origin is on their base."""
    above = poses[..., :3].reshape(-1, 3) + np.array([[0, 0, _SUNK]], np.float32)
    return workspace.has_left(above).reshape(poses.shape[:-1])


def tilted(poses: Any) -> Any:
    """Return which objects [...] bool at poses [..., 7] lean more than `TILTED`."""
    return 1 - 2 * (poses[..., 4] ** 2 + poses[..., 5] ** 2) < math.cos(TILTED)
