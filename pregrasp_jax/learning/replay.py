"""Prioritized replay under jit: a ring of observations, and small rows that refer to them.

An observation is stored once: the end of a push is the beginning of the next, and hindsight rows share the
observations of the episode that they relabel. What is forgotten is decided by the observations alone: a row loses its
priority, for ever, in the same `add` that overwrites one of its observations, and the ring of rows is long enough
never to overwrite a row that is still alive.

Source: Schaul et al. 2016 (proportional variant); Sec. III-E of the paper.
"""

from collections.abc import Callable
from typing import Any

import flax.struct as struct
import jax
import jax.numpy as jnp

from pregrasp_jax.learning import sum_tree
from pregrasp_jax.learning.sum_tree import SumTree
from pregrasp_jax.types import HandPose, Observation, Outcome

MIN_TD_ERROR = 1e-3
"""Added to |TD error|, so that no transition is forgotten because it was once predicted well."""

InputFn = Callable[[Observation, jax.Array], Any]
"""``(observation, goal slot ())`` -> what the network reads, a pytree, unbatched; [H, W, 2] for the paper's."""


class Steps(struct.PyTreeNode):
    """One push in each of E scenes; every leaf has the leading axis E.

    A branch, another push from the state of a scene, counts as a scene whose episodes are one push long.

    Attributes:
        root: [E] int32, which of the scenes holds the same `obs`: itself, or the scene that it branches from.
        obs: before the push.
        action: [E] int32.
        goal: [E] int32 slot of the target.
        outcome: what the push did.
        reward: [E] float32 for `goal`.
        terminated: [E] bool, the value of the next state is 0.
        reason: [E] int32 index into `REASONS`.
        truncated: [E] bool, the episode ends but its last state keeps its value.
        next_obs: after the push, before any reset; the next step's `obs` unless the episode ends.
    """

    root: jax.Array
    obs: Observation
    action: jax.Array
    goal: jax.Array
    outcome: Outcome
    reward: jax.Array
    terminated: jax.Array
    reason: jax.Array
    truncated: jax.Array
    next_obs: Observation


class Rows(struct.PyTreeNode):
    """Transitions; every leaf has one leading axis.

    Attributes:
        obs_slot: int32 slot of the observation before the push.
        next_obs_slot: int32 slot of the observation after it.
        goal: int32 object slot that `reward` and `terminated` are about.
        action: int32.
        reward: float32.
        terminated: bool.
        reason: int32 index into `REASONS`.
        hindsight: bool, `goal` was not the target when the push was made.
        outcome: what the push did, for any goal.
    """

    obs_slot: jax.Array
    next_obs_slot: jax.Array
    goal: jax.Array
    action: jax.Array
    reward: jax.Array
    terminated: jax.Array
    reason: jax.Array
    hindsight: jax.Array
    outcome: Outcome


class Episodes(struct.PyTreeNode):
    """Where the current episode of each scene lies; an ended one stays until the next `add`.

    Attributes:
        obs_slot: [E] int32 slot of the newest observation.
        rows: [E, max_pushes] int32 rows of the episode's pushes, in order.
        length: [E] int32 pushes so far.
        ended: [E] bool.
    """

    obs_slot: jax.Array
    rows: jax.Array
    length: jax.Array
    ended: jax.Array


class Replay(struct.PyTreeNode):
    """The memory.

    Attributes:
        observations: [capacity, H, W] per leaf; observation number n is in slot n % capacity.
        rows: transitions; row number n is in slot n % num_slots.
        priorities: one leaf per row, already raised to the priority exponent; 0 is never sampled.
        episodes: of the E scenes.
        observations_written: () int32 ever.
        rows_written: () int32 ever.
        hindsight_rows_written: () int32 ever.
    """

    observations: Observation
    rows: Rows
    priorities: SumTree
    episodes: Episodes
    observations_written: jax.Array
    rows_written: jax.Array
    hindsight_rows_written: jax.Array

    @property
    def num_alive(self) -> jax.Array:
        """Return the number () int32 of rows that can be sampled."""
        return jnp.sum(self.priorities.leaves > 0)


class Batch(struct.PyTreeNode):
    """B sampled transitions.

    Attributes:
        inputs: network input before the push, fused for the row's goal; leading axis B.
        next_inputs: the same after it.
        action: [B] int32.
        reward: [B] float32.
        terminated: [B] bool.
        reason: [B] int32 index into `REASONS`.
        next_hand: where the hand had been sent after the push; leaves have the leading axis B.
        importance_weights: [B] float32 in (0, 1], largest 1.
        hindsight: [B] bool.
        rows: [B] int32, for `set_priorities`.
    """

    inputs: Any
    next_inputs: Any
    action: jax.Array
    reward: jax.Array
    terminated: jax.Array
    reason: jax.Array
    next_hand: HandPose
    importance_weights: jax.Array
    hindsight: jax.Array
    rows: jax.Array


def init(steps: Any, *, capacity: int, max_pushes: int) -> Replay:
    """Return an empty memory.

    Args:
        steps: a `Steps` of E scenes, or its shapes (`jax.eval_shape`).
        capacity: observations, 20 kB each.
        max_pushes: longest episode.

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
    )
    replay, row_slots = append(replay, rows, jnp.ones(num_envs, bool))
    position = jnp.where(fresh, 0, replay.episodes.length)
    episodes = Episodes(
        obs_slot=rows.next_obs_slot,
        rows=replay.episodes.rows.at[jnp.arange(num_envs), position].set(row_slots, mode="drop"),
        length=position + 1,
        ended=steps.terminated | steps.truncated,
    )
    return replay.replace(episodes=episodes)


def append(replay: Replay, rows: Rows, valid: jax.Array) -> tuple[Replay, jax.Array]:
    """Write the rows [K] that are `valid` [K], with the largest priority in the memory.

    Returns:
        The memory and the slots [K] int32 of the rows; the number of slots (out of range) where not valid.
    """
    num_slots = replay.priorities.capacity
    slots = _ring_slots(replay.rows_written, valid, num_slots)
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
    """Draw transitions in proportion to their priorities; at least one row must be alive.

    Args:
        replay: the memory.
        key: consumed.
        batch_size: B.
        importance_exponent: beta; 0 leaves the bias of prioritized sampling, 1 corrects it fully.
        input_fn: fuses an observation for a goal.
    """
    slots = sum_tree.sample(replay.priorities, key, batch_size)
    rows = jax.tree.map(lambda leaf: leaf[slots], replay.rows)

    def inputs(obs_slots: jax.Array) -> Any:
        images = jax.tree.map(lambda leaf: leaf[obs_slots], replay.observations)
        return jax.vmap(input_fn)(images, rows.goal)

    return Batch(
        inputs=inputs(rows.obs_slot),
        next_inputs=inputs(rows.next_obs_slot),
        action=rows.action,
        reward=rows.reward,
        terminated=rows.terminated,
        reason=rows.reason,
        next_hand=jax.tree.map(lambda leaf: leaf[rows.next_obs_slot], replay.observations.hand),
        importance_weights=_importance_weights(replay, slots, importance_exponent),
        hindsight=rows.hindsight,
        rows=slots,
    )


def set_priorities(replay: Replay, rows: jax.Array, td_errors: jax.Array, *, priority_exponent: float) -> Replay:
    """Set the priorities of rows [B] to (|TD error| + MIN_TD_ERROR)^priority_exponent; dead rows stay dead."""
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


def _importance_weights(replay: Replay, slots: jax.Array, exponent: jax.Array | float) -> jax.Array:
    """Return (1 / (N p))^exponent over its largest in the batch, [B]."""
    priority = replay.priorities.leaves[slots]
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
