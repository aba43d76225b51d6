"""How strokes are judged: what the hand holds, what that is worth for the target, and why an episode ends.

Source: *stable* and what is taken away are PPG's (see `push_grasp`), the rest is the target-oriented protocol of the
paper that this package implements, as docs/baselines.md reads it.
"""

import flax.struct as struct
import jax
import jax.numpy as jnp
import numpy as np

from pregrasp_jax.config import TaskConfig
from pregrasp_jax.robot.base import Robot
from pregrasp_jax.scene.model import parking_poses
from pregrasp_jax.spaces.workspace import Workspace
from pregrasp_jax.task.primitive import Plan, Primitive
from pregrasp_jax.task.push_grasp import LIFTED, PushGrasp, has_left, tilted
from pregrasp_jax.task.rules import RUNNING, Rules, Verdict
from pregrasp_jax.types import MAX_OBJECTS, REASONS, EnvState, HullBank, Touch

TARGET_HELD = REASONS.index("target_held")


class GraspOutcome(struct.PyTreeNode):
    """What a stroke did.

    Attributes:
        collided: () bool, the hand touched something on its way down.
        held: [MAX_OBJECTS] bool, lifted.
        stable: [MAX_OBJECTS] bool, held alone and not by fingertips only; one object at the most.
        toppled: [MAX_OBJECTS] bool, fallen or leaning, not lifted.
        off_table: [MAX_OBJECTS] bool, left the workspace, not lifted.
        final: () bool, as in `PushGrasp`.
        obstruction: () int32 index into `OBSTRUCTIONS`.
        diverged: () bool, the physics diverged.
    """

    collided: jax.Array
    held: jax.Array
    stable: jax.Array
    toppled: jax.Array
    off_table: jax.Array
    final: jax.Array
    obstruction: jax.Array
    diverged: jax.Array


def standing(state: EnvState) -> jax.Array:
    """Return which objects [MAX_OBJECTS] bool have not been taken away."""
    parked = jnp.asarray(parking_poses()[:, :3], jnp.float32)
    away = jnp.all(jnp.abs(state.physics_obs.object_poses[:, :3] - parked) < 1e-3, axis=-1)
    return (state.scene.object_ids >= 0) & ~away


def make_rules(robot: Robot, workspace: Workspace, primitive: Primitive, bank: HullBank, task: TaskConfig) -> Rules:
    """Return the rules of the target-oriented protocol.

    The target held stably, alone, is success; held with another object, off the table or fallen, it is lost. Obstacles
    may leave in any way, but a stroke that is meant for the target must not end with one of them in the hand.

    Raises:
        ValueError: the robot has no fingertips, so that no grasp of it is stable.
    """
    del primitive, bank
    if not robot.fingertips:
        raise ValueError(f"robot {robot.name} names no fingertips; allowed for primitive push_grasp is one that does")
    tips = np.isin(robot.links.names, robot.fingertips)

    def measure(before: EnvState, after: EnvState, plan: Plan) -> GraspOutcome:
        touch, stroke = after.physics_obs.touch, plan.stroke
        assert touch is not None and isinstance(stroke, PushGrasp), "the engine of strokes"
        present, executed = standing(before), plan.reachable
        held = present & executed & ~touch.collided & (touch.poses[2, :, 2] > LIFTED)
        on_table = present & executed & ~held
        return GraspOutcome(
            collided=touch.collided & executed,
            held=held,
            stable=held & stable(touch, tips),
            toppled=on_table & tilted(touch.poses[2]),
            off_table=on_table & has_left(touch.poses[2], workspace),
            final=stroke.final,
            obstruction=plan.obstruction,
            diverged=after.physics_obs.diverged,
        )

    def judge(outcome: GraspOutcome, goal: jax.Array) -> Verdict:
        reason = end_reason(outcome, goal)
        reward = task.in_region_reward * (reason == TARGET_HELD)
        return Verdict(jnp.float32(reward), reason != RUNNING, reason)

    def hindsight_goal(outcome: GraspOutcome, goal: jax.Array, eligible: jax.Array) -> tuple[jax.Array, jax.Array]:
        others = outcome.stable & eligible & (jnp.arange(MAX_OBJECTS) != goal)
        return jnp.argmax(others).astype(jnp.int32), jnp.any(others)

    return Rules(measure, judge, hindsight_goal, successes=(TARGET_HELD,), asks_for_grasp=False)  # pyright: ignore[reportArgumentType]


def stable(touch: Touch, tips: np.ndarray) -> jax.Array:
    """Return which object [MAX_OBJECTS] bool the hand holds by itself, and not with its fingertips alone.

    Args:
        touch: at the end of a stroke.
        tips: [L] bool, the links that are fingertips.
    """
    touched = jnp.any(touch.contacts, axis=0)
    return touched & (jnp.sum(touched) == 1) & jnp.any(touch.contacts & ~tips[:, None], axis=0)


def end_reason(outcome: GraspOutcome, goal: jax.Array) -> jax.Array:
    """Return why a stroke ends an episode with target `goal` () int32; `RUNNING` if it does not."""
    is_goal = jnp.arange(MAX_OBJECTS) == goal
    holds = {
        "nan": outcome.diverged,
        "unreachable": outcome.obstruction != 0,
        "target_held": jnp.any(outcome.stable & is_goal),
        "target_not_alone": jnp.any(outcome.held & is_goal),
        "obstacle_grasped": outcome.final & jnp.any(outcome.held & ~is_goal),
        "off_table": jnp.any(outcome.off_table & is_goal),
        "target_toppled": jnp.any(outcome.toppled & is_goal),
    }
    reason = jnp.int32(RUNNING)
    for name in reversed(holds):
        reason = jnp.where(holds[name], REASONS.index(name), reason)
    return reason.astype(jnp.int32)
