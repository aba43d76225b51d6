"""Hindsight: an episode that enclosed the wrong object is a success for that object (Sec. III-E).

The whole episode is replayed with the enclosed obstacle as the goal. Rewards come from the same `judge` that
`env.step` calls, applied to the stored outcome of every push, so nothing about them is approximate.
"""

import functools

import jax
import jax.numpy as jnp

from pregrasp_jax.judge import OBSTACLE_IN_REGION, end_reason, in_region, judge
from pregrasp_jax.learning import replay as replay_lib
from pregrasp_jax.learning.replay import Replay
from pregrasp_jax.types import Outcome


def enclosed_obstacle(
    outcome: Outcome, goal: jax.Array, eligible: jax.Array, *, obstacles_may_leave: bool = False
) -> tuple[jax.Array, jax.Array]:
    """Return which obstacle the last push of an episode enclosed, and whether it may be a goal.

    Args:
        outcome: of the last push, unbatched.
        goal: () int32 slot of the episode's target.
        eligible: [MAX_OBJECTS] bool, slots whose object may be a target.
        obstacles_may_leave: see `judge.end_reason`.

    Returns:
        slot () int32, the eligible obstacle of the largest coverage; found () bool, whether the episode ended
        with `obstacle_in_region` and there is such an obstacle.
    """
    assert outcome.coverage.shape == eligible.shape, f"{outcome.coverage.shape} and {eligible.shape} differ"
    # A target in the region as well never gets here: `end_reason` prefers it.
    candidates = in_region(outcome) & eligible
    reason = end_reason(outcome, goal, obstacles_may_leave=obstacles_may_leave)
    slot = jnp.argmax(jnp.where(candidates, outcome.coverage, -1.0)).astype(jnp.int32)
    found = jnp.any(candidates) & (reason == OBSTACLE_IN_REGION)
    return slot, found


def relabel(
    outcomes: Outcome, length: jax.Array, goal: jax.Array, *, obstacles_may_leave: bool = False
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Judge an episode anew for another goal.

    Args:
        outcomes: of up to P pushes in order, leading axis P.
        length: () int32 pushes made.
        goal: () int32 slot.
        obstacles_may_leave: see `judge.end_reason`.

    Returns:
        reward [P] float32, terminated [P] bool, and valid [P] bool: the pushes up to and including the one that
        ends the relabelled episode. It may end before the real one, for example if the new goal was toppled.
    """
    judge_push = functools.partial(judge, obstacles_may_leave=obstacles_may_leave)
    reward, terminated, _ = jax.vmap(judge_push, in_axes=(0, None))(outcomes, goal)
    steps = jnp.arange(terminated.shape[0])
    ended_before = jnp.cumsum(terminated, dtype=jnp.int32) > terminated.astype(jnp.int32)
    return reward, terminated, (steps < length) & ~ended_before


def add_hindsight(replay: Replay, eligible: jax.Array, *, obstacles_may_leave: bool = False) -> Replay:
    """Add rows for the episodes that the last `replay.add` ended by enclosing an eligible obstacle.

    Call it once after each `replay.add`, or never (the No-HER ablation).

    Args:
        replay: the memory.
        eligible: [E, MAX_OBJECTS] bool for the scenes of that `add`, before any reset.
        obstacles_may_leave: see `judge.end_reason`.
    """
    episodes = replay.episodes
    rows = jax.tree.map(lambda leaf: leaf[episodes.rows], replay.rows)
    last = jax.tree.map(lambda leaf: jax.vmap(lambda x, n: x[n - 1])(leaf, episodes.length), rows)
    rule = {"obstacles_may_leave": obstacles_may_leave}
    goal, found = jax.vmap(functools.partial(enclosed_obstacle, **rule))(last.outcome, last.goal, eligible)
    reward, terminated, valid = jax.vmap(functools.partial(relabel, **rule))(rows.outcome, episodes.length, goal)
    relabelled = rows.replace(
        goal=jnp.broadcast_to(goal[:, None], valid.shape),
        reward=reward,
        terminated=terminated,
        hindsight=jnp.ones_like(valid),
    )
    valid = valid & (found & episodes.ended)[:, None]
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), relabelled)
    return replay_lib.append(replay, flat, valid.ravel())[0]
