"""What the replay is made of: a push as it comes in, a row, the memory, and the batch that comes out."""

from collections.abc import Callable
from typing import Any

import flax.struct as struct
import jax
import jax.numpy as jnp

from pregrasp_jax.learning.sum_tree import SumTree
from pregrasp_jax.types import HandPose, Observation, Outcome

UNKNOWN = float("-inf")
"""Value of a next state that nobody has looked at yet."""

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
        siblings: [..., K] int32 rows of pushes from the same state for the same goal, this one included; -1 for none.
        next_value: float32 value of the next state when it was last looked at; before that 0 if it terminated, else
            `UNKNOWN`.
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
    siblings: jax.Array
    next_value: jax.Array


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
    def num_siblings(self) -> int:
        """Return K, how many pushes from one state are drawn together."""
        return self.rows.siblings.shape[1]

    @property
    def num_alive(self) -> jax.Array:
        """Return the number () int32 of rows that can be sampled."""
        return jnp.sum(self.priorities.leaves > 0)


class Batch(struct.PyTreeNode):
    """B sampled transitions, each with its siblings: K pushes from one state.

    Attributes:
        inputs: network input before the pushes, fused for the row's goal; leading axis B.
        next_inputs: the same after the push that was drawn.
        next_hand: where the hand had been sent after that push; leaves have the leading axis B.
        importance_weights: [B] float32 in (0, 1], largest 1.
        hindsight: [B] bool.
        rows: [B, K] int32, for `set_priorities`; -1 for none.
        drawn: [B, K] bool, which one was drawn; its next state is the only one that may be looked at.
        next_values: [B, K] float32 of the next states when they were last looked at, `UNKNOWN` if never.
        action: [B, K] int32.
        reward: [B, K] float32.
        terminated: [B, K] bool.
        reason: [B, K] int32 index into `REASONS`.
    """

    inputs: Any
    next_inputs: Any
    next_hand: HandPose
    importance_weights: jax.Array
    hindsight: jax.Array
    rows: jax.Array
    drawn: jax.Array
    next_values: jax.Array
    action: jax.Array
    reward: jax.Array
    terminated: jax.Array
    reason: jax.Array
