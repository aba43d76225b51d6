"""A Q-function: what the network sees of an observation, and what it says about pushes."""

import functools
from dataclasses import dataclass
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from pregrasp_jax import grid
from pregrasp_jax.config import NetworkConfig, TaskConfig
from pregrasp_jax.heightmap import network_input
from pregrasp_jax.learning.compact import CompactNetwork, look_around_hand, window_size
from pregrasp_jax.learning.networks import QNetwork
from pregrasp_jax.learning.replay import InputFn
from pregrasp_jax.types import Observation

Params = Any

_COMPACT_CHANNELS = 128
"""Channels of the compact network at width 1."""


@dataclass(frozen=True)
class QFunction:
    """A network and its input.

    Attributes:
        network: has ``__call__(inputs) -> [B, H, W, 2]`` and ``q_of_action(inputs, action [B]) -> [B]``.
        input_fn: (observation, target slot) -> inputs, unbatched.
    """

    network: nn.Module
    input_fn: InputFn

    def init(self, key: jax.Array) -> Params:
        """Return initial parameters."""
        blank = jnp.zeros((grid.GRID_SIZE, grid.GRID_SIZE), jnp.uint8)
        inputs = self.input_fn(Observation(blank, blank, jnp.zeros(2)), jnp.int32(0))
        return self.network.init(key, jax.tree.map(lambda leaf: leaf[None], inputs))["params"]

    def fits(self, params: Params) -> bool:
        """Return whether parameters belong to this network."""
        expected = jax.eval_shape(self.init, jax.random.key(0))

        def shapes(tree: Any) -> Any:
            return jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), tree)

        return shapes(params) == shapes(expected)

    def apply(self, params: Params, inputs: Any) -> jax.Array:
        """Return the values [B, H, W, 2] of all pushes."""
        return jnp.asarray(self.network.apply({"params": params}, inputs))

    def of_action(self, params: Params, inputs: Any, action: jax.Array) -> jax.Array:
        """Return the values [B] of the pushes `action` [B] only, the same as in `apply` but cheaper."""
        return jnp.asarray(self.network.apply({"params": params}, inputs, action, method="q_of_action"))

    def values(self, params: Params, obs: Observation, target_slot: jax.Array) -> jax.Array:
        """Return the values [H, W, 2] of all pushes after one observation."""
        inputs = self.input_fn(obs, target_slot)
        return self.apply(params, jax.tree.map(lambda leaf: leaf[None], inputs))[0]


def make_q_function(network: NetworkConfig, task: TaskConfig) -> QFunction:
    """Return the Q-function of a configuration."""
    if network.architecture == "paper":
        return QFunction(QNetwork(width=network.width, initial_bias=network.initial_bias), network_input)
    channels = max(1, round(_COMPACT_CHANNELS * network.width))
    return QFunction(
        CompactNetwork(channels=channels, initial_bias=network.initial_bias),
        functools.partial(look_around_hand, size=window_size(task)),
    )
