"""Contacts between two convex hulls by the separating axis test, written for wide arrays instead of branches.

Everything an edge pair needs is a dot product of something of edge i with something of edge j (triple products
are rotated until that is so), hence one fused loop over all pairs instead of gathered edges.
"""

import jax
import jax.numpy as jnp
from mujoco.mjx._src import collision_convex, math
from mujoco.mjx._src.collision_types import ConvexInfo

_NONE = 1.0
"""m; distance of a contact that does not exist, as in MJX."""

_PREFER_FACE = 1e-5
"""m; an edge pair must separate better than every face by this much, or rounding would flip between the two."""

_PARALLEL = 1e-5
"""Squared sine below which two edges are parallel: some face normal then separates as well as their cross product."""


def hull_hull(a: ConvexInfo, b: ConvexInfo) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return dist [4], pos [4, 3] and normal [4, 3] (from a to b) of two hulls.

    The deepest distance is the least translation that parts them: up to four corners of the overlap of two faces,
    or one point between two edges. Distance 1 marks contacts that do not exist.

    Source: deepest distance and normal agree with MuJoCo's `mjc_Convex` (tests/test_mjx.py says how well).
    """
    a = _turned(a, a.pos - b.pos)
    b = _turned(b, jnp.zeros(3))
    face_gap, normal, (reference, incident) = _best_face(a, b)
    edge_gap, edge_normal, edge_point = _best_edges(a, b)
    is_edge = edge_gap > face_gap + _PREFER_FACE
    dist, pos = _clipped(reference, incident, face_gap)
    first = jnp.arange(4) == 0
    dist = jnp.where(is_edge, jnp.where(first, edge_gap, _NONE), dist)
    pos = jnp.where(is_edge, edge_point[None], pos) + b.pos[None]
    dist = jnp.where(jnp.maximum(face_gap, edge_gap) < 0, dist, _NONE)
    return dist, pos, jnp.tile(jnp.where(is_edge, edge_normal, normal), (4, 1))


def _turned(hull: ConvexInfo, offset: jax.Array) -> ConvexInfo:
    """Return the hull with world axes, its centre at `offset`."""
    rotate = hull.mat.T
    return hull.replace(
        vert=hull.vert @ rotate + offset[None],
        face=hull.face @ rotate + offset[None, None],
        face_normal=hull.face_normal @ rotate,
        edge_face_normal=hull.edge_face_normal @ rotate,
        size=offset,
    )


def _best_face(
    a: ConvexInfo, b: ConvexInfo
) -> tuple[jax.Array, jax.Array, tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]]:
    """Return the widest gap along any face normal, that normal from a to b, and the two faces that meet there."""
    gap_a, gap_b = _face_gaps(a, b.vert), _face_gaps(b, a.vert)
    from_a = gap_a.max() >= gap_b.max()
    normal = jnp.where(from_a, a.face_normal[gap_a.argmax()], -b.face_normal[gap_b.argmax()])
    on_a = jnp.where(from_a, gap_a.argmax(), (a.face_normal @ normal).argmax())
    on_b = jnp.where(from_a, (b.face_normal @ normal).argmin(), gap_b.argmax())
    corners = max(a.face.shape[1], b.face.shape[1])
    face_a, face_b = (_corners(hull.face[face], corners) for hull, face in ((a, on_a), (b, on_b)))
    side_a, side_b = (face_a, a.face_normal[on_a]), (face_b, b.face_normal[on_b])
    faces = jax.tree.map(lambda x, y: (jnp.where(from_a, x, y), jnp.where(from_a, y, x)), side_a, side_b)
    (reference, incident), (reference_normal, incident_normal) = faces
    gap = jnp.maximum(gap_a.max(), gap_b.max())
    return gap, normal, ((reference, reference_normal), (incident, incident_normal))


def _face_gaps(hull: ConvexInfo, points: jax.Array) -> jax.Array:
    """Return the signed distance [F] from each face to the nearest of points [V, 3] along its normal."""
    return _dots(hull.face_normal, points).min(axis=1) - jnp.sum(hull.face_normal * hull.face[:, 0], axis=-1)


def _corners(polygon: jax.Array, count: int) -> jax.Array:
    return jnp.concatenate([polygon, jnp.repeat(polygon[-1:], count - len(polygon), axis=0)])


def _clipped(
    reference: tuple[jax.Array, jax.Array], incident: tuple[jax.Array, jax.Array], gap: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return dist [4] and pos [4, 3] of the part of the incident face that lies behind the reference face.

    The corners lie half way between the two surfaces. Where rounding or a steep incident face leaves nothing, the
    deepest corner of the incident face stands in, with the gap of the axis.
    """
    (polygon, normal), (other, other_normal) = reference, incident
    points, inside = collision_convex._clip(polygon, other, normal, other_normal)
    depth = (polygon[:1] - points) @ normal
    chosen, distinct = spread(points, depth, inside & (depth > 0), normal)
    dist, pos = jnp.where(distinct, -depth[chosen], _NONE), points[chosen]
    missing = jnp.all(dist >= 0)
    deepest = other[(other @ normal).argmin()]
    dist = jnp.where(missing, jnp.where(jnp.arange(4) == 0, gap, _NONE), dist)
    pos = jnp.where(missing, deepest[None], pos)
    return dist, pos - 0.5 * jnp.minimum(dist, 0.0)[:, None] * normal[None]


def spread(points: jax.Array, depth: jax.Array, mask: jax.Array, normal: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return four indices of masked points [n, 3] that span much area, the deepest first, and which are distinct.

    MJX's own choice starts at the first point of the mask, so the points are turned until that is the deepest.
    """
    count = len(points)
    turned = (jnp.arange(count) + jnp.argmax(jnp.where(mask, depth, -jnp.inf))) % count
    chosen = turned[collision_convex._manifold_points(points[turned], mask[turned], normal)]
    repeated = jnp.any((chosen[:, None] == chosen[None]) & jnp.tri(4, k=-1, dtype=bool), axis=1)
    return chosen, mask[chosen] & ~repeated


def _best_edges(a: ConvexInfo, b: ConvexInfo) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the widest gap along the normal of two edges, that normal from a to b, and the point between them.

    Only pairs whose arcs cross on the Gauss map touch first anywhere (Gregorius, "The Separating Axis Test between
    Convex Polyhedra", GDC 2013).
    """
    start_a, along_a = _edges(a)
    start_b, along_b = _edges(b)
    left_a, right_a = a.edge_face_normal[:, 0], a.edge_face_normal[:, 1]
    left_b, right_b = -b.edge_face_normal[:, 0], -b.edge_face_normal[:, 1]
    arc_a, arc_b = jnp.cross(right_a, left_a), jnp.cross(right_b, left_b)
    before_a, behind_a = _dots(arc_a, left_b), _dots(arc_a, right_b)
    before_b, behind_b = _dots(left_a, arc_b), _dots(right_a, arc_b)
    crossing = (before_a * behind_a < 0) & (before_b * behind_b < 0) & (before_a * behind_b > 0)
    cosine = _dots(along_a, along_b)
    squared_sine = 1 - cosine**2
    on_a = _dots(jnp.cross(start_a, along_a), along_b)
    on_b = _dots(along_a, jnp.cross(along_b, start_b))
    centre = _dots(jnp.cross(jnp.broadcast_to(a.size, along_a.shape), along_a), along_b)
    gap = jnp.where(on_a > centre, on_b - on_a, on_a - on_b) * jax.lax.rsqrt(jnp.maximum(squared_sine, _PARALLEL))
    gap = jnp.where(crossing & (squared_sine > _PARALLEL), gap, -jnp.inf)
    i, j = jnp.unravel_index(gap.argmax(), gap.shape)
    normal = math.normalize(jnp.cross(along_a[i], along_b[j]))
    normal = normal * jnp.where(on_a[i, j] > centre[i, j], 1.0, -1.0)
    ends_a, ends_b = a.vert[a.edge[i]], b.vert[b.edge[j]]
    nearest = math.closest_segment_to_segment_points(ends_a[0], ends_a[1], ends_b[0], ends_b[1])
    return gap.max(), normal, 0.5 * (nearest[0] + nearest[1])


def _edges(hull: ConvexInfo) -> tuple[jax.Array, jax.Array]:
    """Return a point and the unit direction of each edge, both [E, 3]."""
    start, end = hull.vert[hull.edge[:, 0]], hull.vert[hull.edge[:, 1]]
    along = end - start
    return start, along * jax.lax.rsqrt(jnp.sum(along**2, axis=-1, keepdims=True))


def _dots(a: jax.Array, b: jax.Array) -> jax.Array:
    """Return all dot products [I, J] of a [I, 3] and b [J, 3]; as sums, so that they fuse with what uses them."""
    x, y = a[:, None, :], b[None, :, :]
    return x[..., 0] * y[..., 0] + x[..., 1] * y[..., 1] + x[..., 2] * y[..., 2]
