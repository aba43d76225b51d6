"""Prioritized replay under jit: a ring of observations, and small rows that refer to them.

An observation is stored once: the end of a push is the beginning of the next, and hindsight rows share the
observations of the episode that they relabel. What is forgotten is decided by the observations alone: a row loses its
priority, for ever, in the same `add` that overwrites one of its observations, and the ring of rows is long enough
never to overwrite a row that is still alive.

Pushes from one state share its picture, so one pass of the network can learn from all of them. Rows name their
siblings, and keep the value of the state that they lead to as it was when it was last looked at.

Source: Schaul et al. 2016 (proportional variant); Sec. III-E of the paper.
"""

from typing import Any

import jax
import jax.numpy as jnp

from pregrasp_jax.learning import sum_tree
from pregrasp_jax.learning.records import UNKNOWN, Batch, Episodes, InputFn, Replay, Rows, Steps
from pregrasp_jax.types import Observation

MIN_TD_ERROR = 1e-3
"""Added to |TD error|, so that no transition is forgotten because it was once predicted well."""


def init(steps: Any, *, capacity: int, max_pushes: int, num_siblings: int = 1) -> Replay:
    """Return an empty memory.

    Args:
        steps: a `Steps` of E scenes, or its shapes (`jax.eval_shape`).
        capacity: observations, 20 kB each.
        max_pushes: longest episode.
        num_siblings: K pushes from one state that are drawn together: 1, or E over the number of real scenes.

    Raises:
        ValueError: an episode could lose its first observation before it ends.
    """
    num_envs = steps.action.shape[0]
    smallest = 2 * num_envs * (max_pushes + 1)
    if capacity < smallest:
        raise ValueError(
            f"replay capacity = {capacity} is too small for {num_envs} scenes and episodes of {max_pushes} pushes; "
            f"allowed is {smallest} or more"
        )
    # Every push writes at least one observation and at most two rows, one of them up to an episode later.
    num_rows = 2 * capacity + num_envs * max_pushes

    def zeros(length: int, tree: Any) -> Any:
        return jax.tree.map(lambda leaf: jnp.zeros((length, *leaf.shape[1:]), leaf.dtype), tree)

    index, flag = jnp.zeros(num_rows, jnp.int32), jnp.zeros(num_rows, bool)
    rows = Rows(
        obs_slot=index,
        next_obs_slot=index,
        goal=index,
        action=index,
        reward=jnp.zeros(num_rows),
        terminated=flag,
        reason=index,
        hindsight=flag,
        outcome=zeros(num_rows, steps.outcome),
        siblings=jnp.full((num_rows, num_siblings), -1, jnp.int32),
        next_value=jnp.zeros(num_rows),
    )
    episodes = Episodes(
        obs_slot=jnp.zeros(num_envs, jnp.int32),
        rows=jnp.zeros((num_envs, max_pushes), jnp.int32),
        length=jnp.zeros(num_envs, jnp.int32),
        ended=jnp.ones(num_envs, bool),
    )
    return Replay(
        observations=zeros(capacity, steps.obs),
        rows=jax.tree.map(jnp.copy, rows),  # no two leaves may share a buffer, or the memory cannot be donated
        priorities=sum_tree.init(num_rows),
        episodes=episodes,
        observations_written=jnp.int32(0),
        rows_written=jnp.int32(0),
        hindsight_rows_written=jnp.int32(0),
    )


def add(replay: Replay, steps: Steps) -> Replay:
    """Store one push of every scene; new rows get the largest priority in the memory.

    The first push after an episode's end must start from that scene's reset: its `obs` is stored too. A push that
    diverged is kept for the record with priority 0: a failure of the simulator is no fact about the task.
    """
    num_envs = steps.action.shape[0]
    fresh = replay.episodes.ended
    images = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), steps.obs, steps.next_obs)
    unseen = fresh & (steps.root == jnp.arange(num_envs))
    replay, slots = _write_observations(replay, images, jnp.concatenate([unseen, jnp.ones(num_envs, bool)]))
    obs_slot = jnp.where(fresh, slots[:num_envs], replay.episodes.obs_slot)[steps.root]
    rows = Rows(
        obs_slot=obs_slot,
        next_obs_slot=slots[num_envs:],
        goal=steps.goal.astype(jnp.int32),
        action=steps.action.astype(jnp.int32),
        reward=steps.reward,
        terminated=steps.terminated,
        reason=steps.reason.astype(jnp.int32),
        hindsight=jnp.zeros(num_envs, bool),
        outcome=steps.outcome,
        siblings=jnp.zeros((num_envs, replay.num_siblings), jnp.int32),
        next_value=jnp.where(steps.terminated, 0.0, UNKNOWN),
    )
    replay, row_slots = append(replay, rows, jnp.ones(num_envs, bool))
    if replay.num_siblings > 1:
        # Scenes come first, then branch by branch: see `training.collect.Experience`.
        siblings = row_slots.reshape(replay.num_siblings, -1).T[steps.root]
        replay = replay.replace(rows=replay.rows.replace(siblings=replay.rows.siblings.at[row_slots].set(siblings)))
    position = jnp.where(fresh, 0, replay.episodes.length)
    episodes = Episodes(
        obs_slot=rows.next_obs_slot,
        rows=replay.episodes.rows.at[jnp.arange(num_envs), position].set(row_slots, mode="drop"),
        length=position + 1,
        ended=steps.terminated | steps.truncated,
    )
    return replay.replace(episodes=episodes)


def append(replay: Replay, rows: Rows, valid: jax.Array) -> tuple[Replay, jax.Array]:
    """Write the rows [K] that are `valid` [K], with the largest priority in the memory and without siblings.

    Returns:
        The memory and the slots [K] int32 of the rows; the number of slots (out of range) where not valid.
    """
    num_slots = replay.priorities.capacity
    slots = _ring_slots(replay.rows_written, valid, num_slots)
    alone = jnp.arange(replay.num_siblings)[None] == 0
    rows = rows.replace(siblings=jnp.where(alone, slots[:, None], -1))
    largest = jnp.max(replay.priorities.leaves)
    priority = jnp.where(rows.outcome.diverged, 0.0, jnp.where(largest > 0, largest, 1.0))
    replay = replay.replace(
        rows=_scatter(replay.rows, slots, rows),
        priorities=sum_tree.set_leaves(replay.priorities, slots, priority),
        rows_written=replay.rows_written + jnp.sum(valid, dtype=jnp.int32),
        hindsight_rows_written=replay.hindsight_rows_written + jnp.sum(valid & rows.hindsight, dtype=jnp.int32),
    )
    return replay, slots


def sample(
    replay: Replay, key: jax.Array, *, batch_size: int, importance_exponent: jax.Array | float, input_fn: InputFn
) -> Batch:
    """Draw transitions in proportion to their priorities, with their siblings; at least one row must be alive.

    A state is drawn as often as all of its pushes together, which is what the importance weights make good for.

    Args:
        replay: the memory.
        key: consumed.
        batch_size: B.
        importance_exponent: beta; 0 leaves the bias of prioritized sampling, 1 corrects it fully.
        input_fn: fuses an observation for a goal.
    """
    slots = sum_tree.sample(replay.priorities, key, batch_size)
    row = jax.tree.map(lambda leaf: leaf[slots], replay.rows)
    # A sibling is as alive as the row that was drawn, unless it diverged.
    priorities = jnp.where(row.siblings >= 0, replay.priorities.leaves[row.siblings], 0.0)
    rows = jnp.where(priorities > 0, row.siblings, -1)
    pushes = jax.tree.map(lambda leaf: leaf[rows], replay.rows)

    def inputs(obs_slots: jax.Array) -> Any:
        images = jax.tree.map(lambda leaf: leaf[obs_slots], replay.observations)
        return jax.vmap(input_fn)(images, row.goal)

    return Batch(
        inputs=inputs(row.obs_slot),
        next_inputs=inputs(row.next_obs_slot),
        next_hand=jax.tree.map(lambda leaf: leaf[row.next_obs_slot], replay.observations.hand),
        importance_weights=_importance_weights(jnp.sum(priorities, axis=1), importance_exponent),
        hindsight=row.hindsight,
        rows=rows,
        drawn=rows == slots[:, None],
        next_values=jnp.where(rows >= 0, pushes.next_value, UNKNOWN),
        action=pushes.action,
        reward=pushes.reward,
        terminated=pushes.terminated,
        reason=pushes.reason,
    )


def learned(
    replay: Replay, batch: Batch, td_errors: jax.Array, values: jax.Array, *, priority_exponent: float
) -> Replay:
    """Keep what an update has found out about a batch.

    Priorities become (|TD error| + MIN_TD_ERROR)^priority_exponent; dead rows stay dead.

    Args:
        replay: the memory.
        batch: what was drawn from it.
        td_errors: [B, K], counted where `values` are known.
        values: [B, K] of the next states, `UNKNOWN` where they are not.
        priority_exponent: alpha.
    """
    known = (batch.rows >= 0) & (values > UNKNOWN)
    rows = jnp.where(known, batch.rows, replay.priorities.capacity).ravel()
    replay = set_priorities(replay, rows, td_errors.ravel(), priority_exponent=priority_exponent)
    # Only these are news, and all that a row gets that was drawn twice is the same.
    news = jnp.where(values != batch.next_values, batch.rows, replay.priorities.capacity)
    next_value = replay.rows.next_value.at[news].set(values, mode="drop")
    return replay.replace(rows=replay.rows.replace(next_value=next_value))


def set_priorities(replay: Replay, rows: jax.Array, td_errors: jax.Array, *, priority_exponent: float) -> Replay:
    """Set the priorities of rows [B] to (|TD error| + MIN_TD_ERROR)^priority_exponent.

    Dead rows stay dead, and rows out of range are left out.
    """
    priority = (jnp.abs(td_errors) + MIN_TD_ERROR) ** priority_exponent
    alive = replay.priorities.leaves[rows] > 0
    return replay.replace(priorities=sum_tree.set_leaves(replay.priorities, rows, jnp.where(alive, priority, 0.0)))


def forget(replay: Replay, lost: jax.Array) -> Replay:
    """Let the rows die that refer to observations whose slots are `lost` [capacity] bool.

    An episode under way of which something is lost begins anew, for the memory, with its next push.
    """
    rows, episodes = replay.rows, replay.episodes
    stale = lost[rows.obs_slot] | lost[rows.next_obs_slot]
    made = jnp.arange(episodes.rows.shape[1])[None] < episodes.length[:, None]
    broken = lost[episodes.obs_slot] | jnp.any(made & stale[episodes.rows], axis=1)
    return replay.replace(
        priorities=sum_tree.build(jnp.where(stale, 0.0, replay.priorities.leaves)),
        episodes=episodes.replace(ended=episodes.ended | broken),
    )


def _importance_weights(priority: jax.Array, exponent: jax.Array | float) -> jax.Array:
    """Return (1 / (N p))^exponent over its largest in the batch, [B], for p in proportion to `priority` [B]."""
    # N and the total cancel in the ratio: the largest weight belongs to the smallest priority.
    return (jnp.min(priority) / priority) ** exponent


def _write_observations(replay: Replay, images: Observation, valid: jax.Array) -> tuple[Replay, jax.Array]:
    """Write the images [K] that are `valid` [K], and let the rows die that refer to what they overwrite."""
    capacity = jax.tree.leaves(replay.observations)[0].shape[0]
    slots = _ring_slots(replay.observations_written, valid, capacity)
    count = jnp.sum(valid, dtype=jnp.int32)

    def overwritten(slot: jax.Array) -> jax.Array:
        return (slot - replay.observations_written) % capacity < count

    stale = overwritten(replay.rows.obs_slot) | overwritten(replay.rows.next_obs_slot)
    replay = replay.replace(
        observations=_scatter(replay.observations, slots, images),
        priorities=sum_tree.build(jnp.where(stale, 0.0, replay.priorities.leaves)),
        observations_written=replay.observations_written + count,
    )
    return replay, slots


def _ring_slots(written: jax.Array, valid: jax.Array, capacity: int) -> jax.Array:
    """Return the next slots [K] int32 of a ring for the valid items, in order, and `capacity` for the others."""
    offset = jnp.cumsum(valid, dtype=jnp.int32) - 1
    return jnp.where(valid, (written + offset) % capacity, capacity)


def _scatter(arrays: Any, slots: jax.Array, values: Any) -> Any:
    """Set `slots` [K] of every leaf; slots out of range are dropped."""
    return jax.tree.map(lambda leaf, value: leaf.at[slots].set(value, mode="drop"), arrays, values)
