"""Exploration (Sec. III-E): random actions that aim at the target among those that are allowed.

Every function describes one scene (unbatched) and is vmapped by its caller.
"""

import jax
import jax.numpy as jnp
import numpy as np

from pregrasp_jax.spaces import grid
from pregrasp_jax.spaces.actions import ActionSpace
from pregrasp_jax.types import HandPose

_MIN_ANGLE_STD = 1e-3
"""rad; an `angle_std` of 0 means the direction nearest to the target, not a division by zero."""


def linear_schedule(
    step: jax.Array | int, *, start: float, end: float, steps: jax.Array | np.floating | float
) -> jax.Array:
    """Return the value () float32 that moves linearly from `start` at step 0 to `end` at `steps`, then stays."""
    return jnp.float32(start) + jnp.clip(jnp.float32(step) / steps, 0.0, 1.0) * (end - start)


def guided_action(
    key: jax.Array,
    hand: HandPose,
    target_xy: jax.Array,
    mask: jax.Array,
    actions: ActionSpace,
    *,
    angle_std: float,
    open_probability: float,
) -> jax.Array:
    """Draw a push that heads for the target: theta ~ N(direction to the target, angle_std), r uniform.

    The polar density is drawn cell by cell, hence truncated to exactly what the mask allows: radii and
    workspace borders need no projection. If the mask is empty (the environment has ended the episode
    before), the action is meaningless but valid.

    Args:
        key: consumed.
        hand: where the hand has been sent.
        target_xy: [2] m, planar centroid of the target.
        mask: [H, W, K] bool, the actions that are allowed.
        actions: what they mean.
        angle_std: rad.
        open_probability: share of pushes with the hand as open as it gets, where there is a choice.

    Returns:
        () int32 action.

    Source: Sec. III-E, "guided exploration"; 0.5 rad and 0.7 are this project's choice.
    """
    assert hand.xy.shape == target_xy.shape == (2,) and mask.shape == actions.shape, mask.shape
    key_cell, key_choice = jax.random.split(key)
    choice = allowed_choice(mask, draw_choice(key_choice, actions, open_probability=open_probability))
    centers = grid.cell_centers(jnp)
    dx, dy = centers[None, :] - hand.xy[0], centers[:, None] - hand.xy[1]
    direction = jnp.arctan2(target_xy[1] - hand.xy[1], target_xy[0] - hand.xy[0])
    angle = jnp.mod(jnp.arctan2(dy, dx) - direction + jnp.pi, 2 * jnp.pi) - jnp.pi
    # A radius uniform in [r_in, r_out] has density 1/r per unit of area, which is what a cell is.
    log_density = -0.5 * (angle / max(angle_std, _MIN_ANGLE_STD)) ** 2 - 0.5 * jnp.log(dx**2 + dy**2 + 1e-12)
    return _draw_cell(key_cell, jnp.where(mask[..., choice], log_density, -jnp.inf), choice, actions)


def softmax_action(key: jax.Array, q: jax.Array, mask: jax.Array, *, temperature: float) -> jax.Array:
    """Draw a push in proportion to exp(Q / temperature) among those that are allowed.

    Args:
        key: consumed.
        q: [H, W, K].
        mask: [H, W, K] bool, at least one action.
        temperature: in units of Q.

    Returns:
        () int32 action.
    """
    logits = jnp.where(mask, q / temperature, -jnp.inf)
    return jax.random.categorical(key, logits.ravel()).astype(jnp.int32)


def best_apart(q: jax.Array, mask: jax.Array, actions: ActionSpace, *, count: int, spacing: float) -> jax.Array:
    """Return the best pushes that differ: each ends at least `spacing` away from all better ones of its choice.

    Args:
        q: [H, W, K].
        mask: [H, W, K] bool, at least one action.
        actions: what they mean.
        count: how many; where no more can be told apart they begin anew with the best.
        spacing: m.

    Returns:
        [count] int32, the best first.
    """

    def take(left: jax.Array, _: None) -> tuple[jax.Array, jax.Array]:
        left = jnp.where(jnp.any(left), left, mask)
        action = jnp.argmax(jnp.where(left, q, -jnp.inf)).astype(jnp.int32)
        return left & ~actions.near(action, spacing), action

    return jax.lax.scan(take, mask, None, length=count)[1]


def random_action(key: jax.Array, mask: jax.Array, actions: ActionSpace) -> jax.Array:
    """Draw a choice uniformly, and then a cell.

    The Random-Exp ablation draws from all cells that the network values, allowed or not. One that the hand cannot reach
    ends the episode.

    Args:
        key: consumed.
        mask: [H, W, K] bool, where to draw from.
        actions: what they mean.

    Returns:
        () int32 action.
    """
    assert mask.shape == actions.shape, mask.shape
    key_cell, key_choice = jax.random.split(key)
    choice = allowed_choice(mask, draw_choice(key_choice, actions))
    return _draw_cell(key_cell, jnp.where(mask[..., choice], 0.0, -jnp.inf), choice, actions)


def draw_choice(key: jax.Array, actions: ActionSpace, *, open_probability: float | None = None) -> jax.Array:
    """Draw a choice () int32.

    Args:
        key: consumed.
        actions: what there is to choose from.
        open_probability: that of the choices of the largest aperture together; where they are all that there is, or if
            this is None, all choices are equally likely.
    """
    apertures = np.array([choice.aperture for choice in actions.choices])
    widest = apertures == apertures.max()
    share = widest.mean() if open_probability is None or widest.all() else open_probability
    if widest.tolist() == [False, True]:
        return jax.random.bernoulli(key, share).astype(jnp.int32)
    weights = np.where(widest, share / widest.sum(), (1 - share) / max((~widest).sum(), 1))
    return jax.random.categorical(key, jnp.log(jnp.asarray(weights, jnp.float32))).astype(jnp.int32)


def allowed_choice(mask: jax.Array, choice: jax.Array) -> jax.Array:
    """Return a choice () int32, or the first one with which something is allowed if nothing is with that.

    Args:
        mask: [H, W, K] bool, the actions that are allowed.
        choice: () int32.
    """
    possible = jnp.any(mask, axis=(0, 1))
    return jnp.where(possible[choice], choice, jnp.argmax(possible)).astype(jnp.int32)


def _draw_cell(key: jax.Array, logits: jax.Array, choice: jax.Array, actions: ActionSpace) -> jax.Array:
    row, col = jnp.divmod(jax.random.categorical(key, logits.ravel()), logits.shape[1])
    return actions.encode(row, col, choice)
