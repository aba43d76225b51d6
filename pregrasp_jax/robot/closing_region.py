"""Whether an object stands where the closing fingers will hold it.

The closing region is the rectangle that the fingers sweep while they close, palm to fingertip, in the hand frame;
an object's coverage is the share of its vertical projection (the union of its hulls) inside. It is integrated over
lines across the hand: on each line a hull's projection is one interval, whose ends lie on projected edges.
"""

import jax
import jax.numpy as jnp
import numpy as np

from pregrasp_jax.assets.bank import CLOSING_REGION_SIZE
from pregrasp_jax.geometry import quat_to_matrix, transform_points
from pregrasp_jax.robot import description
from pregrasp_jax.types import OPEN, HullBank

NUM_LINES = 48
"""Lines over an object's extent along the hand; the coverage is good to 0.004, on the worst of 2800 random objects."""


def closing_region_bounds() -> tuple[np.ndarray, np.ndarray]:
    """Return the corners [2] with smallest and largest (x, y) in the grasp point frame, m; it begins at the palm."""
    mj_model = description.robot_model()
    palm = mj_model.geom(description.PALM_GEOM)
    depth, width = CLOSING_REGION_SIZE
    start = palm.pos[0] + palm.size[0] - description.grasp_offset()
    return np.array([start, -width / 2]), np.array([start + depth, width / 2])


def coverage(
    vertices: jax.Array,
    edges: jax.Array,
    present: jax.Array,
    object_pose: jax.Array,
    hand_pose: jax.Array,
    aperture: jax.Array,
) -> jax.Array:
    """Return the share of an object's vertical projection inside the closing region.

    Args:
        vertices: [K, V, 3] m, hulls in the object frame.
        edges: [K, E, 2] vertex indices.
        present: [K] bool.
        object_pose: [7] in the world.
        hand_pose: [7] grasp point in the world; of its rotation only the heading counts.
        aperture: () `CLOSED` or `OPEN`.

    Returns:
        () in [0, 1]; 0 while the hand is closed (there is no region then) and where no hull is present.

    Source: DESIGN, Closing region. Agrees with polygon clipping (shapely) within 0.004.
    """
    xy = _in_hand_frame(transform_points(object_pose, vertices), hand_pose)
    ends = jax.vmap(lambda points, pairs: points[pairs])(xy, edges)
    low, high = closing_region_bounds()
    counted, some = present[:, None], jnp.any(present)
    first = jnp.where(some, jnp.min(jnp.where(counted, xy[..., 0], jnp.inf)), 0.0)
    last = jnp.where(some, jnp.max(jnp.where(counted, xy[..., 0], -jnp.inf)), 1.0)
    step = (last - first) / NUM_LINES
    x = first + step * (jnp.arange(NUM_LINES) + 0.5)
    bottom, top = jax.vmap(_cut, (0, None))(ends, x)
    bottom, top = jnp.where(counted, bottom, jnp.inf), jnp.where(counted, top, -jnp.inf)
    whole = _union_length(bottom, top)
    inside = _union_length(jnp.maximum(bottom, low[1]), jnp.minimum(top, high[1]))
    # A line stands for a strip, of which the region may hold a part.
    share = jnp.clip((jnp.minimum(x + step / 2, high[0]) - jnp.maximum(x - step / 2, low[0])) / step, 0.0, 1.0)
    area = jnp.sum(whole)
    covered = jnp.where(area > 0, jnp.sum(inside * share) / jnp.where(area > 0, area, 1.0), 0.0)
    return jnp.where(aperture == OPEN, covered, 0.0)


def scene_coverage(
    bank: HullBank, object_ids: jax.Array, poses: jax.Array, hand_pose: jax.Array, aperture: jax.Array
) -> jax.Array:
    """Return the `coverage` [MAX_OBJECTS] of every object of a scene, 0 for empty slots.

    Args:
        bank: the catalogue.
        object_ids: [MAX_OBJECTS] int32, -1 for an empty slot.
        poses: [MAX_OBJECTS, 7] in the world.
        hand_pose: [7] grasp point in the world.
        aperture: () `CLOSED` or `OPEN`.
    """
    hulls = jnp.asarray(bank.object_hulls)[object_ids]
    present = (hulls >= 0) & (object_ids >= 0)[:, None]
    vertices, edges = jnp.asarray(bank.full.vertices)[hulls], jnp.asarray(bank.full.edges)[hulls]
    return jax.vmap(coverage, (0, 0, 0, 0, None, None))(vertices, edges, present, poses, hand_pose, aperture)


def _in_hand_frame(points: jax.Array, hand_pose: jax.Array) -> jax.Array:
    """Return the horizontal coordinates [..., 2] of world points [..., 3] along and across the hand's heading."""
    forward = quat_to_matrix(hand_pose[3:])[:2, 0]
    cos, sin = forward / jnp.linalg.norm(forward)
    x, y = points[..., 0] - hand_pose[0], points[..., 1] - hand_pose[1]
    return jnp.stack([cos * x + sin * y, cos * y - sin * x], axis=-1)


def _cut(ends: jax.Array, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Cut the projection of one hull with lines.

    Args:
        ends: [E, 2, 2] projected end points of its edges, m; the outline is made of some of them.
        x: [L] m.

    Returns:
        The interval [L], [L] of y on each line, m; (inf, -inf) where the line misses.
    """
    (xa, ya), (xb, yb) = ends[:, 0].T, ends[:, 1].T
    along = jnp.where(xa == xb, 1.0, xb - xa)
    slope = (yb - ya) / along
    offset = ya - slope * xa
    y = slope[:, None] * x[None] + offset[:, None]
    crossed = (x[None] >= jnp.minimum(xa, xb)[:, None]) & (x[None] < jnp.maximum(xa, xb)[:, None])
    return jnp.min(jnp.where(crossed, y, jnp.inf), axis=0), jnp.max(jnp.where(crossed, y, -jnp.inf), axis=0)


def _union_length(bottom: jax.Array, top: jax.Array) -> jax.Array:
    """Return the length [L] of the union of K intervals [K, L]; those with top <= bottom are empty.

    The union is the span of all intervals less the gaps; a gap starts at a top that no other interval covers.
    """
    valid = top > bottom
    bottom, top = jnp.where(valid, bottom, jnp.inf), jnp.where(valid, top, -jnp.inf)
    covered = jnp.any((bottom[None] <= top[:, None]) & (top[None] > top[:, None]), axis=1)
    # Of equal tops only the first counts.
    order = jnp.arange(len(top))
    repeated = jnp.any((top[None] == top[:, None]) & (order[None] < order[:, None])[..., None], axis=1)
    following = jnp.min(jnp.where(bottom[None] > top[:, None], bottom[None], jnp.inf), axis=1)
    is_gap = valid & ~covered & ~repeated & jnp.isfinite(following)
    gaps = jnp.sum(jnp.where(is_gap, following - top, 0.0), axis=0)
    return jnp.where(jnp.any(valid, axis=0), jnp.max(top, axis=0) - jnp.min(bottom, axis=0) - gaps, 0.0)
