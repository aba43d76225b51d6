"""Policies that read a network: they are restricted to what the camera sees."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.tree_util import Partial

from pregrasp_jax.learning.learner import greedy_action
from pregrasp_jax.policies.scripts import Policy
from pregrasp_jax.spaces.actions import REFUSED_RADIUS
from pregrasp_jax.task.env import Env
from pregrasp_jax.types import EnvState, Observation


def make_learned(
    env: Env,
    q_values: Callable[[Any, Observation, jax.Array], jax.Array],
    *,
    reachable: bool = False,
) -> Callable[[Any], Policy]:
    """Return the constructor params -> policy of greedy pushes among those that are allowed.

    A policy is a `jax.tree_util.Partial` whose bound parameters are leaves, so that an evaluation compiled once serves
    every checkpoint of a run.

    Args:
        env: says which actions are allowed.
        q_values: (params, observation, target slot) -> Q [H, W, K].
        reachable: take the best push that the arm can make, instead of the best of all.
    """

    def act(params: Any, state: EnvState, key: jax.Array) -> jax.Array:
        del key
        q, mask = q_values(params, state.obs, state.scene.target), env.action_mask(state.hand)
        return best_reachable(env, state, q, mask) if reachable else greedy_action(q, mask)

    return lambda params: Partial(act, params)


def best_reachable(env: Env, state: EnvState, q: jax.Array, mask: jax.Array) -> jax.Array:
    """Return the best push () int32 whose motion the arm can make, as a robot takes it; the best if there is none.

    Pushes are planned in turn, best first; those of the same choice that end within 2 cm of a refused one are left out.

    Args:
        env: plans.
        state: a running scene.
        q: [H, W, K].
        mask: [H, W, K] bool, at least one action.
    """
    actions = env.primitive.actions

    def next_best(tried: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        left, action = tried
        left = left & ~actions.near(action, REFUSED_RADIUS)
        return left, greedy_action(q, left)

    def goes_on(tried: tuple[jax.Array, jax.Array]) -> jax.Array:
        left, action = tried
        return jnp.any(left) & ~env.plan(state, action).reachable

    best = greedy_action(q, mask)
    left, action = jax.lax.while_loop(goes_on, next_best, (mask, best))
    return jnp.where(jnp.any(left), action, best)
