"""Policies that read a network: they are restricted to what the camera sees."""

from collections.abc import Callable
from typing import Any

import jax
from jax.tree_util import Partial

from pregrasp_jax.learning.learner import greedy_action
from pregrasp_jax.policies.scripts import Policy
from pregrasp_jax.task.env import Env
from pregrasp_jax.types import EnvState, Observation


def make_learned(
    env: Env,
    q_values: Callable[[Any, Observation, jax.Array], jax.Array],
) -> Callable[[Any], Policy]:
    """Return the constructor params -> policy of greedy pushes among those that are allowed.

    A policy is a `jax.tree_util.Partial` whose bound parameters are leaves, so that an evaluation compiled once serves
    every checkpoint of a run.

    Args:
        env: says which actions are allowed.
        q_values: (params, observation, target slot) -> Q [H, W, K].
    """

    def act(params: Any, state: EnvState, key: jax.Array) -> jax.Array:
        del key
        return greedy_action(q_values(params, state.obs, state.scene.target), env.action_mask(state.hand))

    return lambda params: Partial(act, params)
