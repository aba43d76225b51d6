"""Exploration (Sec. III-E): random actions that aim at the target inside the half ring.

Every function describes one scene (unbatched) and is vmapped by its caller.
"""

import jax
import jax.numpy as jnp

from pregrasp_jax import grid

_MIN_ANGLE_STD = 1e-3
"""rad; an `angle_std` of 0 means the direction nearest to the target, not a division by zero."""


def linear_schedule(step: jax.Array | int, *, start: float, end: float, steps: int) -> jax.Array:
    """Return the value () float32 that moves linearly from `start` at step 0 to `end` at `steps`, then stays."""
    return jnp.float32(start) + jnp.clip(jnp.float32(step) / steps, 0.0, 1.0) * (end - start)


def guided_action(
    key: jax.Array,
    p1: jax.Array,
    target_xy: jax.Array,
    mask: jax.Array,
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
        p1: [2] m, commanded end of the last push.
        target_xy: [2] m, planar centroid of the target.
        mask: [H, W] bool, cells allowed as the end of the push.
        angle_std: rad.
        open_probability: share of pushes with an open hand.

    Returns:
        () int32 action.

    Source: Sec. III-E, "guided exploration"; 0.5 rad and 0.7 are this project's choice.
    """
    assert p1.shape == target_xy.shape == (2,) and mask.shape == (grid.GRID_SIZE, grid.GRID_SIZE)
    key_cell, key_aperture = jax.random.split(key)
    centers = grid.cell_centers()
    dx, dy = centers[None, :] - p1[0], centers[:, None] - p1[1]
    direction = jnp.arctan2(target_xy[1] - p1[1], target_xy[0] - p1[0])
    angle = jnp.mod(jnp.arctan2(dy, dx) - direction + jnp.pi, 2 * jnp.pi) - jnp.pi
    # A radius uniform in [r_in, r_out] has density 1/r per unit of area, which is what a cell is.
    log_density = -0.5 * (angle / max(angle_std, _MIN_ANGLE_STD)) ** 2 - 0.5 * jnp.log(dx**2 + dy**2 + 1e-12)
    cell = jax.random.categorical(key_cell, jnp.where(mask, log_density, -jnp.inf).ravel())
    aperture = jax.random.bernoulli(key_aperture, open_probability)
    return (2 * cell + aperture).astype(jnp.int32)


def softmax_action(key: jax.Array, q: jax.Array, mask: jax.Array, *, temperature: float) -> jax.Array:
    """Draw a push in proportion to exp(Q / temperature) inside the half ring.

    Args:
        key: consumed.
        q: [H, W, 2].
        mask: [H, W] bool, at least one cell.
        temperature: in units of Q.

    Returns:
        () int32 action.
    """
    logits = jnp.where(mask[..., None], q / temperature, -jnp.inf)
    return jax.random.categorical(key, logits.ravel()).astype(jnp.int32)


def random_action(key: jax.Array, mask: jax.Array) -> jax.Array:
    """Draw a push uniformly, open or closed.

    The Random-Exp ablation draws from all cells that the network values, in the half ring or not. One that the hand
    cannot reach ends the episode.

    Args:
        key: consumed.
        mask: [H, W] bool, cells allowed as the end of the push.

    Returns:
        () int32 action.
    """
    assert mask.shape == (grid.GRID_SIZE, grid.GRID_SIZE), mask.shape
    key_cell, key_aperture = jax.random.split(key)
    cell = jax.random.categorical(key_cell, jnp.where(mask, 0.0, -jnp.inf).ravel())
    return (2 * cell + jax.random.bernoulli(key_aperture)).astype(jnp.int32)
