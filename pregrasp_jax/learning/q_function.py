"""A Q-function: what the network sees of an observation, and what it says about pushes."""

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from pregrasp_jax.config import NetworkConfig, TaskConfig
from pregrasp_jax.heightmap import network_input
from pregrasp_jax.learning.compact import (
    CompactNetwork,
    cells_around_hand,
    look_around_hand,
    mirror_window,
    window_size,
)
from pregrasp_jax.learning.members import Params, join, split
from pregrasp_jax.learning.networks import QNetwork, same_shapes
from pregrasp_jax.learning.records import InputFn
from pregrasp_jax.spaces import grid
from pregrasp_jax.spaces.actions import ActionSpace
from pregrasp_jax.types import HandPose, Observation

_COMPACT_CHANNELS = 128
"""Channels of the compact network at width 1."""


def everywhere(hand: HandPose) -> jax.Array:
    """Return the whole grid [H, W] bool."""
    del hand
    return jnp.ones((grid.GRID_SIZE, grid.GRID_SIZE), bool)


@dataclass(frozen=True)
class QFunction:
    """A network, or several of which the mean counts, and its input.

    Attributes:
        network: has ``__call__(inputs) -> [B, H, W, K]`` and ``q_at(inputs, row [B], col [B]) -> [B, K]``.
        actions: what an action means, K choices.
        input_fn: (observation, target slot) -> inputs, unbatched.
        mirror_fn: inputs of B scenes -> the same reflected in the robot's plane y = 0. Then a value is the mean of what
            the network says of a scene and of its mirror image; None leaves the network alone.
        domain_fn: hand -> [H, W] bool, where a push may end of which the network says anything.
        members: networks of this kind whose mean a value is, see `members`.
    """

    network: nn.Module
    actions: ActionSpace
    input_fn: InputFn
    mirror_fn: Callable[[Any], Any] | None = None
    domain_fn: Callable[[HandPose], jax.Array] = everywhere
    members: int = 1

    def init(self, key: jax.Array) -> Params:
        """Return initial parameters."""
        blank = jnp.zeros((grid.GRID_SIZE, grid.GRID_SIZE), jnp.uint8)
        hand = HandPose(jnp.zeros(2), *jnp.zeros(3))
        inputs = self.input_fn(Observation(blank, blank, hand), jnp.int32(0))
        inputs = jax.tree.map(lambda leaf: leaf[None], inputs)
        keys = [key] if self.members == 1 else jax.random.split(key, self.members)
        return join([self.network.init(key, inputs)["params"] for key in keys])

    @property
    def shapes(self) -> Params:
        """Return the shapes of the parameters."""
        return jax.eval_shape(self.init, jax.random.key(0))

    def fits(self, params: Params) -> bool:
        """Return whether parameters belong to this network."""
        return same_shapes(params, self.shapes)

    def networks(self, params: Params) -> list[Params]:
        """Return the parameters of every member."""
        return split(params, self.members)

    def first(self, params: Params, count: int) -> "tuple[QFunction, Params]":
        """Return the mean of the first `count` members, of all if there are fewer, and their parameters."""
        networks = self.networks(params)[:count]
        return dataclasses.replace(self, members=len(networks)), join(networks)

    def apply(self, params: Params, inputs: Any) -> jax.Array:
        """Return the values [B, H, W, K] of all pushes."""
        q = self._mean(params, inputs)
        if self.mirror_fn is None:
            return q
        mirrored = self._mean(params, self.mirror_fn(inputs))
        return (q + self.actions.mirror_map(mirrored)) / 2

    def _mean(self, params: Params, inputs: Any) -> jax.Array:
        """Return the mean [B, H, W, K] of all members, the scenes taken as they are."""
        each = [jnp.asarray(self.network.apply({"params": member}, inputs)) for member in self.networks(params)]
        return sum(each[1:], start=each[0]) / len(each)

    def at(self, params: Params, inputs: Any, action: jax.Array) -> jax.Array:
        """Return what one member says of the pushes `action` [B] only, the scenes taken as they are, [B]."""
        row, col, choice = self.actions.unravel(action)
        q = jnp.asarray(self.network.apply({"params": params}, inputs, row, col, method="q_at"))
        return jnp.take_along_axis(q, choice[:, None], axis=1)[:, 0]

    def augment(self, key: jax.Array, inputs: Any, action: jax.Array) -> tuple[Any, jax.Array]:
        """Reflect each of B scenes and its pushes [B, ...] with probability 1/2, if there is a `mirror_fn`."""
        if self.mirror_fn is None:
            return inputs, action
        mirrored = jax.random.bernoulli(key, shape=action.shape[:1])
        reflection = self.mirror_fn(inputs), self.actions.mirror(action)
        choose = jax.vmap(jnp.where, in_axes=(0, 0, 0))
        return jax.tree.map(functools.partial(choose, mirrored), reflection, (inputs, action))

    def values(self, params: Params, obs: Observation, target_slot: jax.Array) -> jax.Array:
        """Return the values [H, W, K] of all pushes after one observation."""
        inputs = self.input_fn(obs, target_slot)
        return self.apply(params, jax.tree.map(lambda leaf: leaf[None], inputs))[0]


def make_q_function(network: NetworkConfig, task: TaskConfig, actions: ActionSpace) -> QFunction:
    """Return the Q-function of a configuration, with a value for every choice of `actions`."""
    common = {"num_choices": actions.num_choices, "initial_bias": network.initial_bias}
    if network.architecture == "paper":
        mirror_fn = mirror_images if network.mirror else None
        paper = QNetwork(width=network.width, **common)
        return QFunction(paper, actions, network_input, mirror_fn, members=network.num_members)
    channels, size = max(1, round(_COMPACT_CHANNELS * network.width)), window_size(task)
    return QFunction(
        CompactNetwork(size, channels=channels, path_channels=network.num_path_channels, **common),
        actions,
        functools.partial(look_around_hand, size=size),
        mirror_window if network.mirror else None,
        functools.partial(cells_around_hand, size=size),
        network.num_members,
    )


def mirror_images(images: jax.Array) -> jax.Array:
    """Reflect images [B, H, W, ...] in the robot's plane y = 0: rows are y."""
    return images[:, ::-1]
