"""Policies: who decides the next push.

A policy maps one scene and a key to an action; `jax.vmap` it over scenes. It is either a plain function or a
`jax.tree_util.Partial`, whose bound arrays (network parameters) are leaves, so that an evaluation compiled
once serves every checkpoint of a run. Scripts read the true object poses; only `make_learned` is restricted
to what the camera sees.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.tree_util import Partial

from pregrasp_jax import grid
from pregrasp_jax.env import Env
from pregrasp_jax.exploration import guided_action
from pregrasp_jax.judge import TARGET_IN_REGION
from pregrasp_jax.types import CLOSED, OPEN, EnvState, Observation

Policy = Callable[[EnvState, jax.Array], jax.Array]
"""(state, key) -> action () int32, unbatched."""

CLEAR_DISTANCE = 0.13
"""m; `clear` opens its hand when the grasp point is this near to the target, a little less than a push is long."""

LOOKAHEAD_CANDIDATES = 20
"""First pushes that `lookahead` tries."""

LOOKAHEAD_CONTINUATION = 2
"""`straight` pushes that follow each candidate in its simulation."""

_FAILURE = -10.0
"""What a failed push is worth to `lookahead`, below every distance."""

_GUIDED = {"angle_std": 0.5, "open_probability": 0.7}
"""`ExplorationConfig`'s defaults: the `guided` policy is what exploration looks like at epsilon 1."""


def make_random(env: Env) -> Policy:
    """Return the policy that draws a cell of the half ring and an aperture uniformly."""

    def act(state: EnvState, key: jax.Array) -> jax.Array:
        key_cell, key_aperture = jax.random.split(key)
        cell = jax.random.categorical(key_cell, jnp.where(env.action_mask(state.p1), 0.0, -jnp.inf).ravel())
        return (2 * cell + jax.random.bernoulli(key_aperture)).astype(jnp.int32)

    return act


def make_guided(env: Env) -> Policy:
    """Return the policy of pure guided exploration (Sec. III-E)."""

    def act(state: EnvState, key: jax.Array) -> jax.Array:
        return guided_action(key, state.p1, target_xy(state), env.action_mask(state.p1), **_GUIDED)

    return act


def make_straight(env: Env) -> Policy:
    """Return the policy that moves the open hand straight at the target, as far as the half ring allows."""

    def act(state: EnvState, key: jax.Array) -> jax.Array:
        del key
        row, col = nearest_cell(env.action_mask(state.p1), target_xy(state))
        return grid.encode_action(row, col, jnp.int32(OPEN))

    return act


def make_clear(env: Env) -> Policy:
    """Return `straight` with the hand closed, to clear the way, until the target is within `CLEAR_DISTANCE`."""

    def act(state: EnvState, key: jax.Array) -> jax.Array:
        del key
        target = target_xy(state)
        row, col = nearest_cell(env.action_mask(state.p1), target)
        near = jnp.linalg.norm(target - state.p1) <= CLEAR_DISTANCE
        return grid.encode_action(row, col, jnp.where(near, OPEN, CLOSED))

    return act


def make_lookahead(env: Env, *, num_candidates: int = LOOKAHEAD_CANDIDATES) -> Policy:
    """Return the upper bound: try candidate pushes in simulation, execute the first of the best.

    The candidates are one `straight` push and, half and half, `guided` and `random` ones; each is followed by
    up to `LOOKAHEAD_CONTINUATION` `straight` pushes. Because `straight` is among them, a plan that was found
    once is not lost at the next decision. Best is the earliest success, then the smallest distance to the
    target, then failure. Only the candidate itself can fail: where a continuation would, the hand stops before
    it (0.94 against 0.88 success on 16 scenes when failing continuations condemn their candidate).

    Args:
        env: simulates the candidates. Give it an engine of its own: a vmapped decision steps
            `num_candidates` times as many scenes as the evaluation does.
        num_candidates: at least 3.
    """
    guided, uniform, straight = make_guided(env), make_random(env), make_straight(env)
    num_guided = (num_candidates - 1) // 2

    def continuation_value(state: EnvState, action: jax.Array, key: jax.Array) -> jax.Array:
        state, value, ended = _push(env, state, action, 0)
        for depth in range(1, 1 + LOOKAHEAD_CONTINUATION):
            state, next_value, next_ended = _push(env, state, straight(state, key), depth)
            value = jnp.where(ended | (next_value == _FAILURE), value, next_value)
            ended |= next_ended
        return value

    def act(state: EnvState, key: jax.Array) -> jax.Array:
        keys = jax.random.split(key, num_candidates - 1)
        actions = jnp.concatenate(
            [
                straight(state, key)[None],
                jax.vmap(guided, (None, 0))(state, keys[:num_guided]),
                jax.vmap(uniform, (None, 0))(state, keys[num_guided:]),
            ]
        )
        values = jax.vmap(continuation_value, (None, 0, None))(state, actions, key)
        return actions[jnp.argmax(values)]

    return act


def _push(env: Env, state: EnvState, action: jax.Array, depth: int) -> tuple[EnvState, jax.Array, jax.Array]:
    """Return the next state, what ending there is worth to `lookahead`, and whether the episode ended there.

    A success is worth 10 less its `depth`, the metres still to go count between 0 and -1.
    """
    state, result = env.step(state, action)
    distance = jnp.minimum(result.outcome.distance_after[state.scene.target], 1.0)
    value = jnp.where(result.terminated, _FAILURE, -distance)
    value = jnp.where(result.reason == TARGET_IN_REGION, 10.0 - depth, value)
    return state, value, result.terminated | result.truncated


def make_learned(
    env: Env,
    q_values: Callable[[Any, Observation, jax.Array], jax.Array],
) -> Callable[[Any], Policy]:
    """Return the constructor params -> policy of greedy pushes inside the half ring.

    Every policy made by one constructor shares its compiled evaluation.

    Args:
        env: says which cells are allowed.
        q_values: (params, observation, target slot) -> Q [H, W, 2].
    """

    def act(params: Any, state: EnvState, key: jax.Array) -> jax.Array:
        del key
        q = q_values(params, state.obs, state.scene.target)
        return jnp.argmax(jnp.where(env.action_mask(state.p1)[..., None], q, -jnp.inf)).astype(jnp.int32)

    return lambda params: Partial(act, params)


SCRIPTS: dict[str, Callable[[Env], Policy]] = {
    "random": make_random,
    "guided": make_guided,
    "straight": make_straight,
    "clear": make_clear,
    "lookahead": make_lookahead,
}
"""Policies that need no training, by the name `evaluate.py --policy` knows them by."""


def target_xy(state: EnvState) -> jax.Array:
    """Return the planar centroid [2] of the target, m."""
    return state.centroids[state.scene.target]


def nearest_cell(mask: jax.Array, point: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return row and col () int32 of the allowed cell whose centre is nearest to `point` [2], m."""
    centers = grid.cell_centers()
    distance_sq = (centers[None, :] - point[0]) ** 2 + (centers[:, None] - point[1]) ** 2
    row, col = jnp.divmod(jnp.argmin(jnp.where(mask, distance_sq, jnp.inf)), grid.GRID_SIZE)
    return row, col
