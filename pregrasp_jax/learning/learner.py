"""Q-learning on pushes: TD target, Huber loss through one pixel, Adam, polyak-averaged target network (Sec. III-E).

The TD functions describe ONE transition and return its error, which is what prioritized replay needs; the learner
vmaps, weights and averages. Nothing here knows the half ring: ``mask_fn(p1 [2]) -> [H, W] bool`` comes as an argument.
"""

from collections.abc import Callable
from typing import Any

import flax.struct as struct
import jax
import jax.numpy as jnp
import optax

from pregrasp_jax.judge import APPROACH_REWARD, IN_REGION_REWARD
from pregrasp_jax.learning import replay as replay_lib
from pregrasp_jax.learning.replay import Batch, InputFn, Replay

Params = Any
ApplyFn = Callable[[Params, jax.Array], jax.Array]
"""``(params, inputs [B, H, W, 2]) -> q [B, H, W, 2]``."""

QAtFn = Callable[[Params, jax.Array, jax.Array], jax.Array]
"""``(params, inputs [B, H, W, 2], action [B]) -> q [B]`` of the taken actions."""

AugmentFn = Callable[[jax.Array, Any, jax.Array], tuple[Any, jax.Array]]
"""``(key, inputs of B scenes, action [B]) -> the same of equivalent scenes``."""

MaskFn = Callable[[jax.Array], jax.Array]
"""``p1 [2] -> [H, W] bool``, the cells where the next push may end."""


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
        q: [H, W, 2].
        mask: [H, W] bool.
    """
    return jnp.argmax(_mask(q, mask)).astype(jnp.int32)


def max_q(q: jax.Array, mask: jax.Array) -> jax.Array:
    """Return the value () of the best allowed push, hence of a state; 0 if the mask is empty.

    Args:
        q: [H, W, 2].
        mask: [H, W] bool.

    Source: Eq. 3.
    """
    return jnp.where(jnp.any(mask), jnp.max(_mask(q, mask)), 0.0)


def _mask(q: jax.Array, mask: jax.Array) -> jax.Array:
    assert q.ndim == 3 and q.shape[:2] == mask.shape, f"expected [H, W, 2] and [H, W], got {q.shape}, {mask.shape}"
    return jnp.where(mask[..., None], q, -jnp.inf)


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


def gather_q(apply_fn: ApplyFn) -> QAtFn:
    """Return a `QAtFn` that evaluates the whole grid and reads one pixel of it; right for any network."""

    def q_at(params: Params, inputs: jax.Array, action: jax.Array) -> jax.Array:
        q = apply_fn(params, inputs)
        return jnp.take_along_axis(q.reshape(q.shape[0], -1), action[:, None], axis=1)[:, 0]

    return q_at


def update(
    state: LearnerState,
    batch: Batch,
    *,
    apply_fn: ApplyFn,
    mask_fn: MaskFn,
    optimizer: optax.GradientTransformation,
    q_at_fn: QAtFn | None = None,
    discount: float = 0.5,
    polyak: float = 0.999,
    huber_delta: float = 0.1,
) -> tuple[LearnerState, jax.Array, dict[str, jax.Array]]:
    """Take one gradient step.

    Args:
        state: what changes.
        batch: B transitions; the gradient of each flows through the pixel of its action only.
        apply_fn: the network on the whole grid.
        mask_fn: the half ring.
        optimizer: Adam with step size 1e-4 in the paper.
        q_at_fn: the network at the taken actions, if there is a cheaper way than `gather_q(apply_fn)`.
        discount: gamma.
        polyak: share of the target network that is kept.
        huber_delta: where the loss turns linear.

    Returns:
        The next state, TD errors [B] (signed) for the priorities, and metrics () each.
    """
    q_at = q_at_fn or gather_q(apply_fn)
    targets = _targets(state, batch, apply_fn=apply_fn, mask_fn=mask_fn, discount=discount)

    def loss_fn(params: Params) -> tuple[jax.Array, jax.Array]:
        errors = jax.vmap(td_error)(q_at(params, batch.inputs, batch.action), targets)
        return jnp.mean(batch.importance_weights * huber(errors, delta=huber_delta)), errors

    (loss, errors), grads = jax.value_and_grad(loss_fn, has_aux=True)(state.params)
    updates, opt_state = optimizer.update(grads, state.opt_state, state.params)
    params = optax.apply_updates(state.params, updates)
    next_state = LearnerState(
        params=params,
        target_params=optax.incremental_update(params, state.target_params, 1.0 - polyak),
        opt_state=opt_state,
        gradient_steps=state.gradient_steps + 1,
    )
    return next_state, errors, _metrics(batch, loss, errors, targets, grads)


def learn(
    state: LearnerState,
    replay: Replay,
    key: jax.Array,
    *,
    batch_size: int,
    input_fn: InputFn,
    importance_exponent: jax.Array | float,
    priority_exponent: float,
    augment_fn: AugmentFn = lambda key, inputs, action: (inputs, action),
    split_fn: Callable[[Batch], Batch] = lambda batch: batch,
    **update_options: Any,
) -> tuple[LearnerState, Replay, dict[str, jax.Array]]:
    """Sample, update, set priorities.

    Args:
        state: of the learner.
        replay: at least one row must be alive.
        key: consumed.
        batch_size: B.
        input_fn: see `replay.sample`.
        importance_exponent: beta, 0.4 -> 1 over training.
        priority_exponent: alpha.
        augment_fn: changes what is learned from to something equivalent.
        split_fn: returns the same batch, spread over several devices.
        **update_options: keyword arguments of `update`.
    """
    sample_key, augment_key = jax.random.split(key)
    batch = replay_lib.sample(
        replay, sample_key, batch_size=batch_size, importance_exponent=importance_exponent, input_fn=input_fn
    )
    batch = split_fn(batch)
    inputs, action = augment_fn(augment_key, batch.inputs, batch.action)
    batch = batch.replace(inputs=inputs, action=action)
    state, errors, metrics = update(state, batch, **update_options)
    replay = replay_lib.set_priorities(replay, batch.rows, errors, priority_exponent=priority_exponent)
    return state, replay, metrics


def _targets(state: LearnerState, batch: Batch, *, apply_fn: ApplyFn, mask_fn: MaskFn, discount: float) -> jax.Array:
    """Return y [B]."""
    masks = jax.vmap(mask_fn)(batch.next_p1)
    values = jax.vmap(max_q)(apply_fn(state.target_params, batch.next_inputs), masks)
    return jax.vmap(lambda r, t, v: td_target(r, t, v, discount=discount))(batch.reward, batch.terminated, values)


def _metrics(
    batch: Batch, loss: jax.Array, errors: jax.Array, targets: jax.Array, grads: Params
) -> dict[str, jax.Array]:
    succeeded, approached = batch.reward == IN_REGION_REWARD, batch.reward == APPROACH_REWARD
    return {
        "train/loss": loss,
        "train/td_error": jnp.mean(jnp.abs(errors)),
        "train/target_mean": jnp.mean(targets),
        "train/target_min": jnp.min(targets),
        "train/target_max": jnp.max(targets),
        "train/q_taken": jnp.mean(targets + errors),
        "train/grad_norm": optax.tree.norm(grads),
        "train/share_success": jnp.mean(succeeded.astype(jnp.float32)),
        "train/share_approach": jnp.mean(approached.astype(jnp.float32)),
        "train/share_nothing": jnp.mean((~succeeded & ~approached).astype(jnp.float32)),
        "train/share_hindsight": jnp.mean(batch.hindsight.astype(jnp.float32)),
    }
