"""Strokes drawn at random as PPG explores: from beside the clutter toward a point of its outline.

Functions describe one scene (unbatched). They look at the height map only.
"""

import flax.struct as struct
import jax
import jax.numpy as jnp

from pregrasp_jax.spaces import grid
from pregrasp_jax.spaces.actions import ActionSpace
from pregrasp_jax.task.push_grasp import APERTURE, DISTANCE, HEADINGS, HEIGHT, PushGrasp, push_grasp

NEAREST, FARTHEST = (round(distance / grid.HEIGHTMAP_RESOLUTION) for distance in (0.10, DISTANCE))
"""Cells between the start of a stroke and the nearest cell that is higher than the hand; the second is its length."""


class IndexedStroke(struct.PyTreeNode):
    """A stroke as networks name it.

    Attributes:
        index: () int32, flat index of Q[row, col, heading].
        aperture: () float32 rad.
    """

    index: jax.Array
    aperture: jax.Array


def from_index(actions: ActionSpace, stroke: IndexedStroke) -> PushGrasp:
    """Return the stroke that begins at the cell of an index, with its heading."""
    xy, choice = actions.decode(stroke.index)
    return push_grasp(xy, actions.held(choice)[1], stroke.aperture)


def guided_stroke(key: jax.Array, height: jax.Array, actions: ActionSpace) -> IndexedStroke:
    """Draw a stroke that starts in a band around what is higher than the hand, aimed at a point of its outline.

    Both are uniform. The point lies in the square that a stroke reaches along its sides; the heading is rounded to one
    of the sixteen, the aperture is uniform. Where nothing is high any stroke is drawn.

    Args:
        key: consumed.
        height: [H, W] m.
        actions: sixteen headings per cell.
    """
    start_key, aim_key, aperture_key = jax.random.split(key, 3)
    tall = height > HEIGHT
    distance = squared_distance(tall)
    band = (distance > NEAREST**2) & (distance < FARTHEST**2)
    row, col = _draw_cell(start_key, jnp.where(jnp.any(band), band, True))
    rows, cols = jnp.indices(tall.shape)
    near = (jnp.abs(rows - row) <= FARTHEST) & (jnp.abs(cols - col) <= FARTHEST)
    aims = outline(tall) & near
    aim_row, aim_col = _draw_cell(aim_key, jnp.where(jnp.any(aims), aims, near))
    yaw = jnp.arctan2((aim_row - row).astype(jnp.float32), (aim_col - col).astype(jnp.float32))
    heading = jnp.mod(jnp.round(yaw / (2 * jnp.pi / HEADINGS)).astype(jnp.int32), HEADINGS)
    aperture = jax.random.uniform(aperture_key, minval=APERTURE.low, maxval=APERTURE.high)
    return IndexedStroke(actions.encode(row, col, heading), aperture)


def squared_distance(mask: jax.Array) -> jax.Array:
    """Return the squared distance [H, W], in cells, from each cell to the nearest one of `mask` [H, W] bool.

    Infinite for an empty mask. First along rows, then along columns.
    """
    height, width = mask.shape

    def squares(size: int) -> jax.Array:
        steps = jnp.arange(size, dtype=jnp.float32)
        return (steps[:, None] - steps[None]) ** 2

    along_row = jnp.min(jnp.where(mask[:, None, :], squares(width)[None], jnp.inf), axis=-1)
    return jnp.min(along_row[None] + squares(height)[..., None], axis=1)


def outline(mask: jax.Array) -> jax.Array:
    """Return the cells [H, W] bool of a mask that have a neighbour outside of it."""
    padded = jnp.pad(mask, 1)
    inner = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    return mask & ~inner


def _draw_cell(key: jax.Array, allowed: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Draw row and column uniformly among the cells [H, W] bool that are allowed."""
    flat = jax.random.categorical(key, jnp.where(allowed, 0.0, -jnp.inf).ravel())
    row, col = jnp.divmod(flat, allowed.shape[1])
    return row.astype(jnp.int32), col.astype(jnp.int32)
