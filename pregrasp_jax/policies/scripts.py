"""Policies that need no training. They read the true object poses.

A policy maps one scene and a key to an action; `jax.vmap` it over scenes.
"""

from collections.abc import Callable
from typing import Any

import flax.struct as struct
import jax
import jax.numpy as jnp

from pregrasp_jax.config import ExplorationConfig
from pregrasp_jax.policies.exploration import allowed_choice, guided_action, random_action
from pregrasp_jax.spaces import grid
from pregrasp_jax.spaces.actions import ActionSpace
from pregrasp_jax.task.env import Env
from pregrasp_jax.types import EnvState

Policy = Callable[[EnvState, jax.Array], Any]
"""(state, key) -> action, unbatched: () int32 or what else the primitive takes."""

CLEAR_DISTANCE = 0.13
"""m; `clear` opens its hand when the grasp point is this near to the target, a little less than a push is long."""

LOOKAHEAD_CANDIDATES = 20
"""First pushes that `lookahead` tries."""

LOOKAHEAD_CONTINUATION = 3
"""Pushes that may follow each candidate in its simulation."""

_SUCCESS, _FAILURE = 10.0, -10.0
"""What a grasp that holds and a failed push are worth to `lookahead`, above and below minus every distance."""

_GUIDED = {name: getattr(ExplorationConfig(), name) for name in ("angle_std", "open_probability")}
"""The `guided` policy is what exploration looks like at epsilon 1."""


def make_random(env: Env) -> Policy:
    """Return the policy that draws a choice uniformly, and a cell that is allowed with it."""

    def act(state: EnvState, key: jax.Array) -> jax.Array:
        return random_action(key, env.action_mask(state.hand), env.primitive.actions)

    return act


def make_guided(env: Env) -> Policy:
    """Return the policy of pure guided exploration (Sec. III-E)."""

    def act(state: EnvState, key: jax.Array) -> jax.Array:
        mask = env.action_mask(state.hand)
        return guided_action(key, state.hand, state.target_xy, mask, env.primitive.actions, **_GUIDED)

    return act


def make_straight(env: Env) -> Policy:
    """Return the policy that moves the open hand straight at the target, as far as is allowed."""
    actions = env.primitive.actions

    def act(state: EnvState, key: jax.Array) -> jax.Array:
        del key
        return nearest_action(env.action_mask(state.hand), state.target_xy, jnp.int32(actions.widest), actions)

    return act


def make_clear(env: Env) -> Policy:
    """Return `straight` with the hand closed, to clear the way, until the target is within `CLEAR_DISTANCE`."""
    actions = env.primitive.actions

    def act(state: EnvState, key: jax.Array) -> jax.Array:
        del key
        near = jnp.linalg.norm(state.target_xy - state.hand.xy) <= CLEAR_DISTANCE
        choice = jnp.where(near, actions.widest, actions.narrowest)
        return nearest_action(env.action_mask(state.hand), state.target_xy, choice, actions)

    return act


def make_lookahead(env: Env, *, num_candidates: int = LOOKAHEAD_CANDIDATES) -> Policy:
    """Return the upper bound: search a plan in simulation, execute its first push.

    The candidates for the first push are one each of `straight` and `clear` and, half and half, `guided` and
    `random` ones. They are continued by turns by `straight` and by `clear`, all of them one push at a time, until
    the first plan encloses the target and its grasp holds, or `LOOKAHEAD_CONTINUATION` pushes have followed. Physics
    repeats itself and each of the two scripts is itself a candidate that it continues, so that a plan which was
    found once is carried out, unless a shorter one turns up. Without a plan the candidate is best that leads
    nearest to the target. Only the candidate itself can fail: where a continuation would, the hand stops before it
    (0.94 against 0.88 success on 16 scenes when failing continuations condemn their candidate). docs/task.md has
    what each of these was worth.

    Args:
        env: simulates the candidates. Give it an engine of its own: a vmapped decision steps
            `num_candidates` times as many scenes as the evaluation does.
        num_candidates: at least 4.
    """
    guided, uniform, straight, clear = make_guided(env), make_random(env), make_straight(env), make_clear(env)
    num_guided = (num_candidates - 2) // 2

    def candidates(state: EnvState, key: jax.Array) -> jax.Array:
        keys = jax.random.split(key, num_candidates - 2)
        return jnp.concatenate(
            [
                jnp.stack([straight(state, key), clear(state, key)]),
                jax.vmap(guided, (None, 0))(state, keys[:num_guided]),
                jax.vmap(uniform, (None, 0))(state, keys[num_guided:]),
            ]
        )

    def continuation(states: EnvState, key: jax.Array) -> jax.Array:
        by_turns = [jax.vmap(script, (0, None))(states, key) for script in (straight, clear)]
        return jnp.where(jnp.arange(num_candidates) % 2 == 0, *by_turns)

    def act(state: EnvState, key: jax.Array) -> jax.Array:
        first = candidates(state, key)

        def advance(plans: _Plans) -> _Plans:
            actions = jnp.where(plans.depth == 0, first, continuation(plans.states, key))
            return _advance(env, plans, actions)

        plans = jax.lax.while_loop(_unfinished, advance, _start(state, num_candidates))
        return first[jnp.argmax(plans.values)]

    return act


class _Plans(struct.PyTreeNode):
    """Candidates of one decision, each with what followed it so far.

    Attributes:
        depth: () int32 pushes simulated.
        states: where each candidate has led, [C, ...].
        values: [C] `_SUCCESS` if the target was enclosed and held, else minus the metres between it and the hand at
            the last state that was not a failure, or `_FAILURE`.
        ended: [C] bool, nothing can follow.
    """

    depth: jax.Array
    states: EnvState
    values: jax.Array
    ended: jax.Array


def _start(state: EnvState, num_candidates: int) -> _Plans:
    states = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (num_candidates, *jnp.shape(leaf))), state)
    return _Plans(jnp.int32(0), states, jnp.zeros(num_candidates), jnp.zeros(num_candidates, bool))


def _unfinished(plans: _Plans) -> jax.Array:
    """Return whether there is something to simulate and no success yet, () bool."""
    more = ~jnp.all(plans.ended) & (plans.depth <= LOOKAHEAD_CONTINUATION)
    return more & ~jnp.any(plans.values == _SUCCESS)


def _advance(env: Env, plans: _Plans, actions: jax.Array) -> _Plans:
    """Push once more wherever that can still matter, and try the grasps which that makes possible.

    In a batch the loop goes on until its last scene is through; the others must not cost physics meanwhile.
    """
    execute = ~plans.ended & _unfinished(plans)
    states, results = jax.vmap(lambda state, action, go: env.step(state, action, execute=go))(
        plans.states, actions, execute
    )
    held = _first_grasp(env, states, execute & env.rules.succeeded(results.reason))
    distance = jax.vmap(lambda outcome, target: outcome.distance_after[target])(results.outcome, states.scene.target)
    failed = jnp.where(plans.depth == 0, _FAILURE, plans.values)
    values = jnp.where(held, _SUCCESS, jnp.where(results.terminated, failed, -distance))
    return _Plans(
        depth=plans.depth + 1,
        # No script looks at a picture: the old one spares drawing a new one. Where the hand is, they ask.
        states=states.replace(obs=plans.states.obs.replace(hand=states.hand)),
        values=jnp.where(execute, values, plans.values),
        ended=plans.ended | (execute & (results.terminated | results.truncated)),
    )


def _first_grasp(env: Env, states: EnvState, enclosed: jax.Array) -> jax.Array:
    """Try grasps, one after the other, of the `enclosed` [C] bool; return [C] bool, the first that holds or none."""

    def untried(carry: tuple[jax.Array, jax.Array]) -> jax.Array:
        waiting, held = carry
        return jnp.any(waiting) & ~jnp.any(held)

    def grasp(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        waiting, held = carry
        index = jnp.argmax(waiting)
        state = jax.tree.map(lambda leaf: leaf[index], states)
        return waiting.at[index].set(False), held.at[index].set(env.grasp(state, execute=untried(carry)).held)

    return jax.lax.while_loop(untried, grasp, (enclosed, jnp.zeros_like(enclosed)))[1]


SCRIPTS: dict[str, Callable[[Env], Policy]] = {
    "random": make_random,
    "guided": make_guided,
    "straight": make_straight,
    "clear": make_clear,
    "lookahead": make_lookahead,
}
"""Policies that need no training, by the name `pregrasp-jax evaluate --policy` knows them by."""


def nearest_action(mask: jax.Array, point: jax.Array, choice: jax.Array, actions: ActionSpace) -> jax.Array:
    """Return the action () int32 that is allowed and ends nearest to `point` [2], m, of a choice () if that can be.

    Args:
        mask: [H, W, K] bool, the actions that are allowed.
        point: [2] m.
        choice: () int32.
        actions: what they mean.
    """
    choice = allowed_choice(mask, choice)
    centers = grid.cell_centers(jnp)
    distance_sq = (centers[None, :] - point[0]) ** 2 + (centers[:, None] - point[1]) ** 2
    row, col = jnp.divmod(jnp.argmin(jnp.where(mask[..., choice], distance_sq, jnp.inf)), grid.GRID_SIZE)
    return actions.encode(row, col, choice)
