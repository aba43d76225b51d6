"""What a push was worth, for any object as the goal.

One function decides reward, termination and reason. `env.step` calls it with the scene's own target and
hindsight relabelling with the enclosed obstacle, so a relabelled episode is judged exactly as a real one.
"""

import jax
import jax.numpy as jnp

from pregrasp_jax.types import REASONS, Outcome

IN_REGION_COVERAGE = 0.95
"""An object is in the closing region if more than this share of its projection is (Sec. III-D)."""

MIN_APPROACH = 1e-3
"""m; the hand moved closer to the goal if the planar distance fell by more than this."""

IN_REGION_REWARD = 2.0
"""Sec. III-D: the target is within the closing region."""

APPROACH_REWARD = 0.5
"""Sec. III-D: the gripper moved closer to the target."""

RUNNING = REASONS.index("running")
TARGET_IN_REGION = REASONS.index("target_in_region")
OBSTACLE_IN_REGION = REASONS.index("obstacle_in_region")


def in_region(outcome: Outcome) -> jax.Array:
    """Return which objects lie in the closing region, [MAX_OBJECTS] bool."""
    return outcome.coverage > IN_REGION_COVERAGE


def end_reason(outcome: Outcome, goal: jax.Array, *, obstacles_may_leave: bool = False) -> jax.Array:
    """Return why the push ends an episode whose target is `goal`, index into `REASONS`; `RUNNING` if it does not.

    The first match in the order of `REASONS` wins. Truncation is not a property of a push and is left to the caller.

    Args:
        outcome: what the push did, unbatched; coverage is 0 while the hand is closed (there is no region then).
        goal: () int32 slot.
        obstacles_may_leave: only the goal ends the episode by leaving the workspace (Sec. IV-A, how the paper counts);
            else every object does (Sec. III-D, how it trains).
    """
    enclosed = in_region(outcome)
    is_goal = jnp.arange(enclosed.shape[0]) == goal
    holds = {
        "nan": outcome.diverged,
        "unreachable": outcome.unreachable,
        "off_table": jnp.any(outcome.off_table & is_goal if obstacles_may_leave else outcome.off_table),
        "target_toppled": jnp.any(outcome.toppled & is_goal),
        "target_in_region": jnp.any(enclosed & is_goal),
        "obstacle_in_region": jnp.any(enclosed & ~is_goal),
        "no_action": outcome.no_action,
    }
    ends = jnp.stack([holds[reason] for reason in REASONS if reason in holds])
    first = REASONS.index("nan") + jnp.argmax(ends)
    return jnp.where(jnp.any(ends), first, RUNNING).astype(jnp.int32)


def reward_terms(outcome: Outcome, goal: jax.Array, reason: jax.Array) -> dict[str, jax.Array]:
    """Return the named terms, () float32 each, whose sum is the reward; at most one is not 0.

    Args:
        outcome: what the push did, unbatched.
        goal: () int32 slot.
        reason: () int32 from `end_reason`.

    Source: Sec. III-D. The approach counts only for a push that does not end the episode.
    """
    # The finite side carries the subtraction, so that a diverged distance_after makes no new NaN.
    approached = outcome.distance_after[goal] < outcome.distance_before[goal] - MIN_APPROACH
    return {
        "target_in_region": IN_REGION_REWARD * (reason == TARGET_IN_REGION).astype(jnp.float32),
        "approach": APPROACH_REWARD * (approached & (reason == RUNNING)).astype(jnp.float32),
    }


def judge(
    outcome: Outcome, goal: jax.Array, *, obstacles_may_leave: bool = False
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Judge one push for one goal.

    Args:
        outcome: what the push did, unbatched; coverage is 0 while the hand is closed.
        goal: () int32 slot of the object that is wanted.
        obstacles_may_leave: see `end_reason`.

    Returns:
        reward () float32, terminated () bool, reason () int32 index into `REASONS` (`RUNNING` if not terminated).
    """
    reason = end_reason(outcome, goal, obstacles_may_leave=obstacles_may_leave)
    reward = sum(reward_terms(outcome, goal, reason).values(), jnp.float32(0.0))
    return reward, reason != RUNNING, reason
