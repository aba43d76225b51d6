"""Whether an object stands where the closing fingers will hold it, and whether it could.

The closing region is what the fingers sweep while they close, in the hand frame; an object's coverage is the share of
its vertical projection (the union of its hulls) inside. It is integrated over lines across the hand: on each line a
hull's projection is one interval, whose ends lie on projected edges.
"""

import jax
import jax.numpy as jnp
import numpy as np

from pregrasp_jax.assets.measure import projection
from pregrasp_jax.geometry import quat_to_matrix, transform_points
from pregrasp_jax.robot.base import ClosingRegion, Eligibility
from pregrasp_jax.types import HullBank

MIN_TARGET_COVERAGE = 0.97
"""An eligible target's best coverage is above this, so that the 0.95 of the task can be reached."""

_NUM_YAWS = 144
"""Yaws at which the coverage is tried: every 2.5 degrees."""

_SAMPLE, _SAMPLE_ERROR = 37, 0.06
"""Every so many cells are looked at first; what they say is at most this far off (0.02 over the built-in objects, 0.044
over random polygons), so that only the yaws which may be the best are measured with all cells."""

NUM_LINES = 48
"""Lines over an object's extent along the hand; the coverage is good to 0.004, on the worst of 2800 random objects."""


def coverage(
    vertices: jax.Array,
    edges: jax.Array,
    present: jax.Array,
    object_pose: jax.Array,
    hand_pose: jax.Array,
    region: ClosingRegion,
) -> jax.Array:
    """Return the share of an object's vertical projection inside the closing region.

    Args:
        vertices: [K, V, 3] m, hulls in the object frame.
        edges: [K, E, 2] vertex indices.
        present: [K] bool.
        object_pose: [7] in the world.
        hand_pose: [7] grasp point in the world; of its rotation only the heading counts.
        region: of the hand; whether it exists now is not asked.

    Returns:
        () in [0, 1]; 0 where no hull is present.

    Source: DESIGN, Closing region. Agrees with polygon clipping (shapely) within 0.004.
    """
    xy = _in_hand_frame(transform_points(object_pose, vertices), hand_pose)
    ends = jax.vmap(lambda points, pairs: points[pairs])(xy, edges)
    counted, some = present[:, None], jnp.any(present)
    first = jnp.where(some, jnp.min(jnp.where(counted, xy[..., 0], jnp.inf)), 0.0)
    last = jnp.where(some, jnp.max(jnp.where(counted, xy[..., 0], -jnp.inf)), 1.0)
    step = (last - first) / NUM_LINES
    x = first + step * (jnp.arange(NUM_LINES) + 0.5)
    bottom, top = jax.vmap(_cut, (0, None))(ends, x)
    bottom, top = jnp.where(counted, bottom, jnp.inf), jnp.where(counted, top, -jnp.inf)
    whole = _union_length(bottom, top)
    stations, half_width = (jnp.asarray(values, jnp.float32) for values in (region.x, region.half_width))
    half = jnp.interp(x, stations, half_width)
    inside = _union_length(jnp.maximum(bottom, -half[None]), jnp.minimum(top, half[None]))
    # A line stands for a strip, of which the region may hold a part.
    share = (jnp.minimum(x + step / 2, stations[-1]) - jnp.maximum(x - step / 2, stations[0])) / step
    share = jnp.clip(share, 0.0, 1.0)
    area = jnp.sum(whole)
    return jnp.where(area > 0, jnp.sum(inside * share) / jnp.where(area > 0, area, 1.0), 0.0)


def scene_coverage(
    bank: HullBank, object_ids: jax.Array, poses: jax.Array, hand_pose: jax.Array, region: ClosingRegion
) -> jax.Array:
    """Return the `coverage` [MAX_OBJECTS] of every object of a scene, 0 for empty slots.

    Args:
        bank: the catalogue.
        object_ids: [MAX_OBJECTS] int32, -1 for an empty slot.
        poses: [MAX_OBJECTS, 7] in the world.
        hand_pose: [7] grasp point in the world.
        region: of the hand.
    """
    hulls = jnp.asarray(bank.object_hulls)[object_ids]
    present = (hulls >= 0) & (object_ids >= 0)[:, None]
    vertices, edges = jnp.asarray(bank.full.vertices)[hulls], jnp.asarray(bank.full.edges)[hulls]
    return jax.vmap(coverage, (0, 0, 0, 0, None, None))(vertices, edges, present, poses, hand_pose, region)


def eligibility(bank: HullBank, region: ClosingRegion, *, max_width: float) -> Eligibility:
    """Return which objects of a bank may be targets: narrow enough, and held well at the best yaw.

    Args:
        bank: host hull bank.
        region: of the open hand.
        max_width: m; an object whose narrowest width is not below this does not fit between the fingers.
    """
    reasons = tuple(_ineligibility(bank, index, region, max_width) for index in range(len(bank.names)))
    return Eligibility(np.array([not reason for reason in reasons], bool), reasons)


def _ineligibility(bank: HullBank, index: int, region: ClosingRegion, max_width: float) -> str:
    """Return why an object cannot be a target, one clause; empty if it can."""
    width = float(bank.min_width[index])
    found = best_coverage(*projection(bank, index), region, enough=MIN_TARGET_COVERAGE)
    reasons = []
    if width >= max_width:
        reasons.append(f"narrowest width {width * 1e3:.1f} mm, must be < {max_width * 1e3:.0f}")
    if found <= MIN_TARGET_COVERAGE:
        # Rounded down, so that what is just too small does not read as if it were enough.
        reasons.append(f"best coverage {np.floor(found * 1000) / 1000:.3f}, must be > {MIN_TARGET_COVERAGE}")
    return "; ".join(reasons)


def best_coverage(cells: np.ndarray, outline: np.ndarray, region: ClosingRegion, *, enough: float = 1.0) -> float:
    """Return the largest share of a projection that fits into the closing region, over yaw.

    At every yaw the object stands flush against the palm (a wall: nothing can lie behind it) and centred
    between the fingers.

    Args:
        cells: [K, 2] points of cells of equal area that cover the vertical projection, m.
        outline: [P, 2] convex outline of the projection, m.
        region: of the open hand.
        enough: the search ends with the first share above this.

    Returns:
        The share in [0, 1].
    """
    yaw = np.arange(_NUM_YAWS) * (2 * np.pi / _NUM_YAWS)
    rough = _coverage_at(yaw, cells[::_SAMPLE], outline, region)
    best = 0.0
    for index in np.argsort(-rough, kind="stable"):
        if best > enough or best >= min(rough[index] + _SAMPLE_ERROR, 1.0):
            break
        best = max(best, float(_coverage_at(yaw[[index]], cells, outline, region)[0]))
    return best


def fitting_yaws(bank: HullBank, region: ClosingRegion) -> np.ndarray:
    """Return the share [N] float32 of all yaws at which each object fits into the region, as in `best_coverage`.

    Args:
        bank: host hull bank.
        region: of the open hand.
    """
    yaw = np.arange(0, _NUM_YAWS, 4) * (2 * np.pi / _NUM_YAWS)
    shares = []
    for index in range(len(bank.names)):
        cells, outline = projection(bank, index)
        shares.append(np.mean(_coverage_at(yaw, cells[::8], outline, region) > MIN_TARGET_COVERAGE))
    return np.array(shares, np.float32)


def _coverage_at(yaw: np.ndarray, cells: np.ndarray, outline: np.ndarray, region: ClosingRegion) -> np.ndarray:
    """Return the share [Y] of the cells that lie in the region at each yaw [Y] rad; see `best_coverage`."""
    stations, half_width = np.asarray(region.x, np.float64), np.asarray(region.half_width, np.float64)
    forward, sideways = np.stack([np.cos(yaw), np.sin(yaw)]), np.stack([-np.sin(yaw), np.cos(yaw)])
    depth = cells @ forward - (outline @ forward).min(axis=0)
    extent = outline @ sideways
    offset = cells @ sideways - (extent.min(axis=0) + extent.max(axis=0)) / 2
    half = np.interp(depth, stations - stations[0], half_width)
    return ((depth <= stations[-1] - stations[0]) & (np.abs(offset) <= half)).mean(axis=0)


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
