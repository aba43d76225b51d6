"""Hindsight: an episode that was a success for another object is replayed as one (Sec. III-E).

The whole episode is replayed with that object as the goal. Rewards come from the same `Rules.judge` that `env.step`
calls, applied to the stored outcome of every push, so nothing about them is approximate.
"""

import jax
import jax.numpy as jnp

from pregrasp_jax.learning import replay as replay_lib
from pregrasp_jax.learning.records import UNKNOWN, Replay
from pregrasp_jax.task.rules import Rules, Verdict
from pregrasp_jax.types import Outcome


def relabel(rules: Rules, outcomes: Outcome, length: jax.Array, goal: jax.Array) -> tuple[Verdict, jax.Array]:
    """Judge an episode anew for another goal.

    Args:
        rules: how pushes are judged.
        outcomes: of up to P pushes in order, leading axis P.
        length: () int32 pushes made.
        goal: () int32 slot.

    Returns:
        The verdict on each push, leading axis P, and valid [P] bool: the pushes up to and including the one that
        ends the relabelled episode. It may end before the real one, for example if the new goal was toppled.
    """
    verdicts = jax.vmap(rules.judge, in_axes=(0, None))(outcomes, goal)
    terminated = verdicts.terminated
    ended_before = jnp.cumsum(terminated, dtype=jnp.int32) > terminated.astype(jnp.int32)
    return verdicts, (jnp.arange(terminated.shape[0]) < length) & ~ended_before


def add_hindsight(replay: Replay, eligible: jax.Array, rules: Rules) -> Replay:
    """Add rows for the episodes that the last `replay.add` ended and that were a success for an eligible object.

    Call it once after each `replay.add`, or never (the No-HER ablation).

    Args:
        replay: the memory.
        eligible: [E, MAX_OBJECTS] bool for the scenes of that `add`, before any reset.
        rules: how pushes are judged.
    """
    episodes = replay.episodes
    rows = jax.tree.map(lambda leaf: leaf[episodes.rows], replay.rows)
    last = jax.tree.map(lambda leaf: jax.vmap(lambda x, n: x[n - 1])(leaf, episodes.length), rows)
    goal, found = jax.vmap(rules.hindsight_goal)(last.outcome, last.goal, eligible)
    verdicts, valid = jax.vmap(lambda *episode: relabel(rules, *episode))(rows.outcome, episodes.length, goal)
    relabelled = rows.replace(
        goal=jnp.broadcast_to(goal[:, None], valid.shape),
        reward=verdicts.reward,
        terminated=verdicts.terminated,
        reason=verdicts.reason,
        hindsight=jnp.ones_like(valid),
        next_value=jnp.where(verdicts.terminated, 0.0, UNKNOWN),
    )
    valid = valid & (found & episodes.ended)[:, None]
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), relabelled)
    return replay_lib.append(replay, flat, valid.ravel())[0]
