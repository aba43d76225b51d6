"""Draw convex hulls on a pixel grid, for any camera, from half-spaces alone.

Along the ray of pixel (row, col), a face n . x <= d bounds the position s of the hit:

    a col + b row + c <= e s

For a vertical ray s is the height z and (a, b, c, e) is (n_x, n_y, -d, -n_z) in pixel units; for a ray from a
pinhole s is the inverse depth 1/t, because the perspective map takes planes to planes. So both views are one
loop: s lies below the smallest bound of the faces with e < 0 and above the largest of those with e > 0, the
pixel is hit if that interval is not empty, and the largest s (highest, nearest) wins.

Hulls are small on the grid: each is cut into square tiles that cover its bounding box, and the tiles of all
hulls are drawn from one list, a chunk at a time, until the list is used up. Absent hulls cost nothing and a
hull of any size, inside or partly outside the grid, is drawn exactly.
"""

import functools

import flax.struct as struct
import jax
import jax.numpy as jnp

_EDGE_ON = 1e-6
"""Faces with |e| below this are parallel to the rays: they bound the pixel only, which a huge slope does too."""

_PIXEL_SLACK = 1e-3
"""Pixels by which bounding boxes grow, far above float32 rounding, far below what another pixel would cost."""

_LEVELS = 2**23 - 1
"""Steps of s in a key: the 23 upper bits of a positive int32; the lower 8 hold the label."""


class PixelHulls(struct.PyTreeNode):
    """K hulls as a camera sees them; see the module docstring for the coefficients.

    Attributes:
        coefficients: [K, F, 4] float32 rows (a, b, c, e) in pixel units; padding may repeat rows.
        box: [K, 4] float32 pixels (row_min, col_min, row_max, col_max) around each hull; may lie off the grid.
        labels: [K] uint8, what to write where the hull is on top.
        present: [K] bool.
    """

    coefficients: jax.Array
    box: jax.Array
    labels: jax.Array
    present: jax.Array


@functools.partial(jax.jit, static_argnames=("shape", "limit", "tile", "chunk"))
def rasterize(
    hulls: PixelHulls, *, shape: tuple[int, int], limit: float, tile: int = 16, chunk: int = 64
) -> tuple[jax.Array, jax.Array]:
    """Draw hulls; at each pixel the largest s wins, at equal s the largest label.

    The result does not depend on the order of the hulls. Hulls with NaN are not drawn.

    Args:
        hulls: what to draw (unbatched).
        shape: pixels (rows, columns) of the image.
        limit: largest s; above it s is clipped. Surfaces at s <= 0 are not seen.
        tile: pixels along the side of a tile.
        chunk: tiles drawn per iteration.

    Returns:
        s [rows, columns] float32 in steps of limit / 2^23, and labels [rows, columns] uint8; both 0 where no
        hull is seen.
    """
    num_hulls = hulls.present.shape[0]
    assert hulls.coefficients.ndim == 3 and hulls.coefficients.shape[2] == 4, hulls.coefficients.shape
    assert hulls.box.shape == (num_hulls, 4) and hulls.labels.shape == (num_hulls,), "one box and label per hull"
    assert min(shape) >= tile, f"tile {tile} is larger than the image {shape}"
    first, tiles_across, ends = _list_tiles(hulls, shape, tile)
    last_corner = jnp.array(shape, jnp.int32)[None, :] - tile

    def draw_chunk(carry):
        start, image = carry
        entry = start + jnp.arange(chunk)
        hull = jnp.minimum(jnp.sum(ends[None, :] <= entry[:, None], axis=1), num_hulls - 1)
        within = entry - jnp.where(hull > 0, ends[hull - 1], 0)
        step = jnp.stack(jnp.divmod(within, tiles_across[hull]), axis=-1)
        # The last tile of a row or column is pushed back inside: drawing a pixel twice changes nothing.
        corner = jnp.minimum(first[hull] + tile * step, last_corner)
        keys = _draw_tiles(hulls.coefficients[hull], corner, hulls.labels[hull], entry < ends[-1], limit, tile)
        return start + chunk, _paste(image, corner, keys)

    _, image = jax.lax.while_loop(
        lambda carry: carry[0] < ends[-1], draw_chunk, (jnp.int32(0), jnp.zeros(shape, jnp.int32))
    )
    return decode_key(image, limit)


def encode_key(s: jax.Array, labels: jax.Array, limit: float) -> jax.Array:
    """Pack s [...] clipped to [0, limit] and labels [...] uint8 into int32 that order by s, then by label."""
    level = jnp.round(jnp.clip(s / limit, 0.0, 1.0) * _LEVELS).astype(jnp.int32)
    return level * 256 + labels.astype(jnp.int32)


def decode_key(keys: jax.Array, limit: float) -> tuple[jax.Array, jax.Array]:
    """Return s [...] float32 and labels [...] uint8 of keys; inverse of `encode_key` up to its rounding."""
    return (keys >> 8).astype(jnp.float32) * (limit / _LEVELS), (keys & 255).astype(jnp.uint8)


def _list_tiles(hulls: PixelHulls, shape: tuple[int, int], tile: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Cover the visible part of each box with tiles.

    Returns:
        first pixel [K, 2], tiles per row [K], and, cumulated over hulls, the number of tiles [K].
    """
    last_pixel = jnp.array(shape, jnp.float32)[None, :] - 1
    low = jnp.maximum(jnp.ceil(hulls.box[:, :2] - _PIXEL_SLACK), 0.0)
    high = jnp.minimum(jnp.floor(hulls.box[:, 2:] + _PIXEL_SLACK), last_pixel)
    seen = hulls.present & jnp.all(low <= high, axis=1)  # False for NaN
    span = jnp.where(seen[:, None], high - low, 0.0).astype(jnp.int32)
    tiles = span // tile + 1
    ends = jnp.cumsum(jnp.where(seen, tiles[:, 0] * tiles[:, 1], 0))
    return jnp.where(seen[:, None], low, 0.0).astype(jnp.int32), tiles[:, 1], ends


@functools.partial(jax.jit, static_argnames=("limit", "tile"))
def _draw_tiles(
    coefficients: jax.Array, corners: jax.Array, labels: jax.Array, drawn: jax.Array, limit: float, tile: int
) -> jax.Array:
    """Return the keys [C, tile, tile] of C hulls; under `jax.jit`, so that a loop that is mapped traces it once."""
    return jax.vmap(functools.partial(_draw_tile, limit=limit, tile=tile))(coefficients, corners, labels, drawn)


def _draw_tile(
    coefficients: jax.Array, corner: jax.Array, label: jax.Array, drawn: jax.Array, *, limit: float, tile: int
) -> jax.Array:
    """Return the keys [tile, tile] of one hull [F, 4] on the tile whose first pixel is `corner` [2]."""
    a, b, c, e = coefficients.T
    row, col = corner[0].astype(jnp.float32), corner[1].astype(jnp.float32)
    # Dividing by e here, and counting pixels from the corner, keeps the loop at one multiply-add per face.
    scale = jnp.where(e > 0, 1.0, -1.0) / jnp.maximum(jnp.abs(e), _EDGE_ON)
    per_col, per_row, at_corner = a * scale, b * scale, (c + a * col + b * row) * scale
    unless_upper = jnp.where(e > 0, jnp.inf, -jnp.inf)
    pixel = jnp.arange(tile, dtype=jnp.float32)
    top = jnp.full((tile, tile), jnp.inf)
    bottom = jnp.full((tile, tile), -jnp.inf)
    # Unrolled, with selects for min and max (which would also carry NaN): XLA makes one vector loop of it, 20
    # times faster on a CPU than a reduction over faces. All of one shape, because jax traces anything else as calls.
    rows, cols = (jax.lax.broadcast_in_dim(pixel, (tile, tile), (axis,)) for axis in (0, 1))
    faces = jax.lax.broadcast_in_dim(
        jnp.stack([per_col, per_row, at_corner, unless_upper]), (4, len(per_col), tile, tile), (0, 1)
    )
    for face in range(len(per_col)):
        along, across, constant, unless = (faces[k, face] for k in range(4))
        bound = along * cols + (across * rows + constant)
        upper = jax.lax.select(bound > unless, bound, unless)
        lower = jax.lax.select(bound < unless, bound, unless)
        top = jax.lax.select(upper < top, upper, top)
        bottom = jax.lax.select(lower > bottom, lower, bottom)
    hit = drawn & (top >= bottom) & (top > 0)
    return jnp.where(hit, encode_key(top, label, limit), 0)


def _paste(image: jax.Array, corners: jax.Array, keys: jax.Array) -> jax.Array:
    """Write tiles [C, tile, tile] into the image where they hold the larger key."""
    windows = jax.lax.ScatterDimensionNumbers(
        update_window_dims=(1, 2), inserted_window_dims=(), scatter_dims_to_operand_dims=(0, 1)
    )
    inside = jax.lax.GatherScatterMode.PROMISE_IN_BOUNDS
    return jax.lax.scatter_max(image, corners, keys, windows, mode=inside)
