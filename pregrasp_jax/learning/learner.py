"""Q-learning on pushes: TD target, Huber loss through one pixel, Adam, polyak-averaged target network (Sec. III-E).

The TD functions describe ONE transition and return its error, which is what prioritized replay needs; the learner
vmaps, weights and averages. Nothing here knows which actions are allowed: ``mask_fn`` comes as an argument.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import flax.struct as struct
import jax
import jax.numpy as jnp
import optax

from pregrasp_jax.config import LearnerConfig, ReplayConfig
from pregrasp_jax.learning import replay as replay_lib
from pregrasp_jax.learning.q_function import Params, QFunction
from pregrasp_jax.learning.records import UNKNOWN, Batch, Replay
from pregrasp_jax.types import HandPose

MaskFn = Callable[[HandPose], jax.Array]
"""``hand -> [H, W, K] bool``, the actions that are allowed next."""


class LearnerState(struct.PyTreeNode):
    """What an update changes.

    Attributes:
        params: of the online network.
        target_params: of the target network, the polyak average of `params`.
        opt_state: of the optimizer.
        gradient_steps: () int32 updates so far.
    """

    params: Params
    target_params: Params
    opt_state: optax.OptState
    gradient_steps: jax.Array


def init(params: Params, optimizer: optax.GradientTransformation) -> LearnerState:
    """Return a learner whose target network equals `params` (a copy: the state may be donated)."""
    target_params = jax.tree.map(jnp.copy, params)
    return LearnerState(params, target_params, optimizer.init(params), jnp.int32(0))


def greedy_action(q: jax.Array, mask: jax.Array) -> jax.Array:
    """Return the flat index () int32 of the best allowed push; 0 if the mask is empty.

    Args:
        q: [H, W, K].
        mask: [H, W, K] bool.
    """
    return jnp.argmax(_mask(q, mask)).astype(jnp.int32)


def max_q(q: jax.Array, mask: jax.Array) -> jax.Array:
    """Return the value () of the best allowed push, hence of a state; 0 if the mask is empty.

    Args:
        q: [H, W, K].
        mask: [H, W, K] bool.

    Source: Eq. 3.
    """
    return jnp.where(jnp.any(mask), jnp.max(_mask(q, mask)), 0.0)


def _mask(q: jax.Array, mask: jax.Array) -> jax.Array:
    assert q.ndim == 3 and q.shape == mask.shape, f"expected [H, W, K] twice, got {q.shape}, {mask.shape}"
    return jnp.where(mask, q, -jnp.inf)


def td_target(reward: jax.Array, terminated: jax.Array, value: jax.Array, *, discount: float) -> jax.Array:
    """Return y () = r + discount (1 - terminated) value, a constant for the gradient. Source: Eq. 3."""
    return jax.lax.stop_gradient(reward + discount * jnp.where(terminated, 0.0, value))


def td_error(q_taken: jax.Array, target: jax.Array) -> jax.Array:
    """Return Q(s, a) - y, signed, (). Source: Eq. 2 before the absolute value."""
    assert q_taken.shape == target.shape == (), f"expected scalars, got {q_taken.shape}, {target.shape}"
    return q_taken - target


def huber(error: jax.Array, *, delta: float) -> jax.Array:
    """Return e^2/2 for |e| <= delta, else delta (|e| - delta/2): continuous, with a gradient of at most delta.

    Source: Eq. 4, whose printed branches (|e|/2 and |e| - 1/2) do not meet at 0.1.
    """
    magnitude = jnp.abs(error)
    return jnp.where(magnitude <= delta, 0.5 * magnitude**2, delta * (magnitude - 0.5 * delta))


def update(
    state: LearnerState,
    batch: Batch,
    *,
    q: QFunction,
    mask_fn: MaskFn,
    successes: Sequence[int],
    optimizer: optax.GradientTransformation,
    config: LearnerConfig,
) -> tuple[LearnerState, jax.Array, jax.Array, dict[str, jax.Array]]:
    """Take one gradient step.

    Every member of `q` learns for itself, towards targets that are the mean of all.

    Args:
        state: what changes.
        batch: B states, each with K pushes; the gradient flows through the pixels of these pushes only.
        q: the network.
        mask_fn: which actions are allowed.
        successes: reasons that count as success.
        optimizer: see `training.learn.make_optimizer`.
        config: discount, polyak, loss, and how many of the next states are valued.

    Returns:
        The next state, TD errors [B, K] of the mean of all members, signed, 0 where nothing is known of the next state,
        the values [B, K] of the next states, `UNKNOWN` where they are not, and metrics () each.
    """
    count = math.ceil(config.valued_share * len(batch.drawn) - 1e-9)
    chosen = to_value(batch, count, state.gradient_steps)
    inputs, hands = jax.tree.map(lambda leaf: leaf[chosen], (batch.next_inputs, batch.next_hand))
    fresh = jax.vmap(max_q)(q.apply(state.target_params, inputs), jax.vmap(mask_fn)(hands))
    stored = batch.next_values
    values = stored.at[chosen].set(jnp.where(batch.drawn[chosen], fresh[:, None], stored[chosen]))
    known = values > UNKNOWN
    discounted = functools.partial(td_target, discount=config.discount)
    targets = jax.vmap(jax.vmap(discounted))(batch.reward, batch.terminated, jnp.where(known, values, 0.0))

    def of_member(params: Params) -> tuple[jax.Array, jax.Array]:
        # Mapped over pushes only: what the network does with the state is done once.
        taken = jax.vmap(q.at, (None, None, 1), 1)(params, batch.inputs, batch.action)
        errors = jnp.where(known, jax.vmap(jax.vmap(td_error))(taken, targets), 0.0)
        losses = batch.importance_weights[:, None] * huber(errors, delta=config.huber_delta)
        return jnp.sum(losses) / jnp.sum(known), errors

    def loss_fn(params: Params) -> tuple[jax.Array, jax.Array]:
        losses, errors = zip(*map(of_member, q.networks(params)), strict=True)
        return jnp.mean(jnp.stack(losses)), jnp.mean(jnp.stack(errors), axis=0)

    (loss, errors), grads = jax.value_and_grad(loss_fn, has_aux=True)(state.params)
    updates, opt_state = optimizer.update(grads, state.opt_state, state.params)
    params = optax.apply_updates(state.params, updates)
    next_state = LearnerState(
        params=params,
        target_params=optax.incremental_update(params, state.target_params, 1.0 - config.polyak),
        opt_state=opt_state,
        gradient_steps=state.gradient_steps + 1,
    )
    return next_state, errors, values, _metrics(batch, loss, errors, targets, known, grads, successes)


def to_value(batch: Batch, count: int, turn: jax.Array) -> jax.Array | slice:
    """Return which `count` of B samples get their next state valued, [count] int32, or a slice of all.

    First those whose next state has no value yet, then those that have one, last those that ended and need none; of a
    kind by turns, since samples are in the order of their rows.

    Args:
        batch: B samples.
        count: 1 to B.
        turn: () int32, at which of B positions a kind begins.
    """
    size = len(batch.drawn)
    if count == size:
        return slice(None)  # devices that share a batch keep their parts
    ended = jnp.any(batch.drawn & batch.terminated, axis=1)
    valued = jnp.any(batch.drawn & (batch.next_values > UNKNOWN), axis=1)
    rank = jnp.where(ended, 2, jnp.where(valued, 1, 0))
    place = (jnp.arange(size) - turn) % size
    return jnp.argsort(rank * size + place)[:count]


def sample_and_update(
    state: LearnerState,
    replay: Replay,
    key: jax.Array,
    *,
    q: QFunction,
    importance_exponent: jax.Array | float,
    replay_config: ReplayConfig,
    config: LearnerConfig,
    split_fn: Callable[[Batch], Batch] = lambda batch: batch,
    **update_options: Any,
) -> tuple[LearnerState, Replay, dict[str, jax.Array]]:
    """Sample, update, keep priorities and values.

    Args:
        state: of the learner.
        replay: at least one row must be alive.
        key: consumed.
        q: the network, its input, and what is equivalent to it.
        importance_exponent: beta, 0.4 -> 1 over training.
        replay_config: alpha.
        config: batch size, and what `update` takes of it.
        split_fn: returns the same batch, spread over several devices.
        **update_options: further keyword arguments of `update`.
    """
    sample_key, augment_key = jax.random.split(key)
    batch = replay_lib.sample(
        replay,
        sample_key,
        batch_size=config.batch_size,
        importance_exponent=importance_exponent,
        input_fn=q.input_fn,
    )
    batch = split_fn(batch)
    inputs, action = q.augment(augment_key, batch.inputs, batch.action)
    batch = batch.replace(inputs=inputs, action=action)
    state, errors, values, metrics = update(state, batch, q=q, config=config, **update_options)
    exponent = replay_config.priority_exponent
    return state, replay_lib.learned(replay, batch, errors, values, priority_exponent=exponent), metrics


def _metrics(
    batch: Batch,
    loss: jax.Array,
    errors: jax.Array,
    targets: jax.Array,
    known: jax.Array,
    grads: Params,
    successes: Sequence[int],
) -> dict[str, jax.Array]:
    succeeded = jnp.any(batch.reason[..., None] == jnp.array(successes)[None, None], axis=-1)
    approached = ~succeeded & (batch.reward > 0)

    def mean(values: jax.Array) -> jax.Array:
        return jnp.sum(jnp.where(known, values, 0.0)) / jnp.sum(known)

    return {
        "train/loss": loss,
        "train/td_error": mean(jnp.abs(errors)),
        "train/target_mean": mean(targets),
        "train/target_min": jnp.min(jnp.where(known, targets, jnp.inf)),
        "train/target_max": jnp.max(jnp.where(known, targets, -jnp.inf)),
        "train/q_taken": mean(targets + errors),
        "train/grad_norm": optax.tree.norm(grads),
        "train/share_success": mean(succeeded.astype(jnp.float32)),
        "train/share_approach": mean(approached.astype(jnp.float32)),
        "train/share_nothing": mean((~succeeded & ~approached).astype(jnp.float32)),
        "train/share_hindsight": jnp.mean(batch.hindsight.astype(jnp.float32)),
    }
