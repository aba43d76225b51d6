"""What a primitive is: how an index of the Q map becomes a motion of the hand, on any robot."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import flax.struct as struct
import jax
import jax.numpy as jnp

from pregrasp_jax.geometry import quat_from_yaw
from pregrasp_jax.robot.base import Robot
from pregrasp_jax.spaces.actions import ActionSpace
from pregrasp_jax.spaces.workspace import Workspace
from pregrasp_jax.types import OBSTRUCTIONS, HandPose


class Stroke(struct.PyTreeNode):
    """Where a motion of the hand begins and ends.

    Attributes:
        start: where the hand is; its aperture is the one that it has now.
        end: where it is sent; with that aperture it moves.
    """

    start: HandPose
    end: HandPose


class Plan(struct.PyTreeNode):
    """A joint trajectory, sampled every `types.CTRL_DT`; it has a static number of rows.

    Attributes:
        ctrl: [T, A] float32 rad or m, position commands with velocity feed-forward; None once it has been executed.
        num_ctrl: () int32 rows to execute; 0 if nothing may be executed.
        seconds: () float32 s, how long the motion takes; 0 if nothing may be executed.
        obstruction: () int32 index into `OBSTRUCTIONS`.
        hand: commanded end of the motion, executed or not.
        stroke: what it was planned for, where rules ask for that.
    """

    ctrl: Any
    num_ctrl: jax.Array
    seconds: jax.Array
    obstruction: jax.Array
    hand: HandPose
    stroke: Stroke | None = None

    @property
    def reachable(self) -> jax.Array:
        """Return () bool, whether it may be executed."""
        return self.obstruction == OBSTRUCTIONS.index("none")

    def unless(self, refused: jax.Array, obstruction: str) -> "Plan":
        """Return the plan, or one that executes nothing where `refused` () bool and nothing else was in the way."""
        code = jnp.where(self.reachable & refused, OBSTRUCTIONS.index(obstruction), self.obstruction)
        return make_plan(self.ctrl, self.num_ctrl, self.seconds, code, self.hand).replace(stroke=self.stroke)


def make_plan(ctrl: Any, num_ctrl: jax.Array, seconds: jax.Array, obstruction: jax.Array, hand: HandPose) -> Plan:
    """Return a plan that executes nothing if something is in the way; see `Plan` for the arguments."""
    fine = obstruction == OBSTRUCTIONS.index("none")
    return Plan(
        ctrl=ctrl,
        num_ctrl=jnp.where(fine, num_ctrl, 0),
        seconds=jnp.where(fine, seconds, 0.0),
        obstruction=obstruction.astype(jnp.int32),
        hand=hand,
    )


@dataclass(frozen=True)
class Primitive:
    """A kind of motion; every function is pure and unbatched.

    Attributes:
        name: as in `TaskConfig.primitive`.
        actions: what an index means.
        mask: (hand) -> [H, W, K] bool, which actions are allowed next.
        decode: (hand, action) -> `Stroke`; an action is () int32, a flat index, or whatever else the primitive takes.
        plan: (joint_pos [J], stroke) -> `Plan`.
        normal: (action) -> the form in which actions are kept.
        motions: motions that people count for one action.
        choice_of: (action in its normal form) -> which of the choices it is, () int32; None for flat indices.
    """

    name: str
    actions: ActionSpace
    mask: Callable[[HandPose], jax.Array]
    decode: Callable[[HandPose, Any], Stroke]
    plan: Callable[[jax.Array, Any], Plan]
    normal: Callable[[Any], Any] = lambda action: action
    motions: int = 1
    choice_of: Callable[[Any], Any] | None = None

    def choice(self, action: Any) -> Any:
        """Return which of the choices () int32 an action is: whose Q map it is drawn on."""
        return self.actions.unravel(action)[2] if self.choice_of is None else self.choice_of(action)


def follow(
    robot: Robot,
    workspace: Workspace,
    joint_pos: jax.Array,
    path: HandPose,
    *,
    num_ctrl: jax.Array,
    seconds: jax.Array,
    hand: HandPose,
    opening: jax.Array | None = None,
) -> Plan:
    """Return the plan of a robot whose hand follows a path.

    Args:
        robot: who moves.
        workspace: what must be kept clear of.
        joint_pos: [J] where the joints are now.
        path: one pose per control row; leaves have the leading axis T.
        num_ctrl: () int32 rows to execute.
        seconds: () float32 s.
        hand: the commanded end.
        opening: [T] aperture that keeps clear of the surroundings, where it is not the commanded one: fingers that are
            told to close stop at what they grasp.
    """
    poses = jnp.concatenate([path.xy, path.z[:, None], jax.vmap(quat_from_yaw)(path.yaw)], axis=1)
    ctrl, code = robot.follow(joint_pos, poses, path.aperture, workspace)
    if opening is not None and workspace.walls:  # the table does not ask how far fingers are open
        code = robot.follow(joint_pos, poses, opening, workspace)[1]
    first = code[jnp.argmax(code != OBSTRUCTIONS.index("none"))]
    return make_plan(ctrl, num_ctrl, seconds, first, hand).unless(num_ctrl > len(ctrl), "too_long")
