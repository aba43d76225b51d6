"""Contacts between a capsule and a convex hull: a capsule is a segment with a radius, and a segment is a thin hull.

Apart, segment and hull are measured by their closest points; once the segment is inside, by the least translation
that takes it out again. Both are exact, where MJX's own test misses deep contacts and errs by millimetres.
"""

import jax
import jax.numpy as jnp
from mujoco.mjx._src.collision_types import ConvexInfo, GeomInfo

from pregrasp_jax.physics.plane_hull import NO_CONTACT
from pregrasp_jax.physics.separating_axis import PREFER_FACE

_INSIDE = 1e-5
"""m; nearer than this to the hull, the direction of the closest points is rounding, and the separating axis decides."""

_PARALLEL = 1e-6
"""Squared sine below which an edge is parallel to the segment: their cross product is rounding."""

_APART = 1e-3
"""Share of the segment between its two contacts from which they are two."""

_ALIKE = 0.99
"""Cosine between the normal of an edge and that of a face from which a capsule that touches the edge rests on the face:
it then has its second contact there, as it would a little less tilted."""


def capsule_hull(capsule: GeomInfo, hull: ConvexInfo) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return dist [2], pos [2, 3] and normal [2, 3] (from the capsule to the hull) of a capsule and a hull.

    The first is the deepest. Where the capsule rests on a face, the second is the other end of what lies above it;
    elsewhere there is none. Distance 1 marks contacts that do not exist.

    Source: the deepest distance is exact within 1e-5 m, against `mj_geomDistance` outside and the hull of the
    Minkowski difference inside (tests/test_capsule_hull.py).
    """
    radius, half_length = capsule.size[0], capsule.size[1]
    centre = hull.mat.T @ (capsule.pos - hull.pos)
    along = half_length * (hull.mat.T @ capsule.mat[:, 2])
    ends = jnp.stack([centre - along, centre + along])
    face_gaps = jnp.min(hull.face_normal @ ends.T - _offsets(hull)[:, None], axis=1)
    face = face_gaps.argmax()
    edge_gaps, edge_normals = _silhouette(ends, hull)
    on_segment, on_edge, distances = _closest_to_edges(ends, hull)
    inside = jnp.maximum(face_gaps[face], edge_gaps.max()) < _INSIDE
    edge = jnp.where(inside, edge_gaps.argmax(), distances.argmin())
    edge_gap = jnp.where(inside, edge_gaps[edge], distances[edge])
    towards = (on_edge[edge] - on_segment[edge]) / jnp.maximum(distances[edge], _INSIDE)
    edge_normal = jnp.where(inside, -edge_normals[edge], towards)

    points, heights, above = _above_face(ends, hull.face[face], hull.face_normal[face])
    face_gap = face_gaps[face]
    # Apart, a face is closest only if what is above it is as near as the whole segment is to its plane.
    facing = above & (face_gap > 0) & (heights[0] < face_gap + PREFER_FACE)
    by_face = jnp.where(inside, face_gap + PREFER_FACE > edge_gap, facing)
    face_normal = -hull.face_normal[face]
    normal = jnp.stack([jnp.where(by_face, face_normal, edge_normal), face_normal])
    first = jnp.where(by_face, points[0], on_segment[edge])
    other = jnp.sum((points - first[None]) ** 2, axis=-1).argmax()
    points = jnp.stack([first, points[other]])
    two = above & (normal[0] @ face_normal > _ALIKE) & _distinct(points, ends)
    least = jnp.where(by_face, face_gap, edge_gap)
    gap = jnp.stack([least, jnp.where(two, jnp.maximum(heights[other], least), jnp.inf)])
    dist = jnp.where(gap < radius, gap - radius, NO_CONTACT)
    pos = points + (radius + 0.5 * jnp.minimum(dist, 0.0))[:, None] * normal
    return dist, pos @ hull.mat.T + hull.pos[None], normal @ hull.mat.T


def _offsets(hull: ConvexInfo) -> jax.Array:
    return jnp.sum(hull.face_normal * hull.face[:, 0], axis=-1)


def _silhouette(ends: jax.Array, hull: ConvexInfo) -> tuple[jax.Array, jax.Array]:
    """Return the gap [E] along the common normal of segment and edge, and that normal [E, 3] out of the hull.

    Only edges of the silhouette, seen along the segment, can touch it before a face does; the others have gap -inf.
    """
    along = ends[1] - ends[0]
    start, edge = _edges(hull)
    side = hull.edge_face_normal @ along
    normal = jnp.cross(along[None], edge)
    squared = jnp.sum(normal**2, axis=-1)
    valid = (side[:, 0] * side[:, 1] < 0) & (squared > _PARALLEL * jnp.sum(along**2) * jnp.sum(edge**2, axis=-1))
    normal *= (jnp.sign(jnp.sum(normal * start, axis=-1)) * jax.lax.rsqrt(jnp.where(valid, squared, 1.0)))[:, None]
    return jnp.where(valid, jnp.sum((ends[:1] - start) * normal, axis=-1), -jnp.inf), normal


def _edges(hull: ConvexInfo) -> tuple[jax.Array, jax.Array]:
    """Return where each edge starts and what leads to its end, both [E, 3] m, in a frame with its origin inside."""
    start = hull.vert[hull.edge[:, 0]]
    return start, hull.vert[hull.edge[:, 1]] - start


def _closest_to_edges(ends: jax.Array, hull: ConvexInfo) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the closest points [E, 3] of segment and edges, on the segment and on the edge, and their distances [E].

    Source: Ericson, "Real-Time Collision Detection" (2005), 5.1.9. MJX's own function adds 1e-6 m2 to squared
    lengths, several percent of those of our edges.
    """
    start, edge = _edges(hull)
    along = ends[1] - ends[0]
    between = ends[0][None] - start
    dot = lambda a, b: jnp.sum(a * b, axis=-1)  # noqa: E731
    length, edge_length, mixed = dot(along, along), dot(edge, edge), dot(edge, along[None])
    squared_sine = length * edge_length - mixed**2
    s = (mixed * dot(edge, between) - edge_length * dot(along[None], between)) / jnp.maximum(squared_sine, 1e-20)
    t = jnp.clip((mixed * jnp.clip(s, 0.0, 1.0) + dot(edge, between)) / edge_length, 0.0, 1.0)
    s = jnp.clip((mixed * t - dot(along[None], between)) / length, 0.0, 1.0)
    on_segment, on_edge = ends[:1] + s[:, None] * along[None], start + t[:, None] * edge
    return on_segment, on_edge, jnp.sqrt(dot(on_segment - on_edge, on_segment - on_edge))


def _above_face(ends: jax.Array, polygon: jax.Array, normal: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the ends [2, 3] of the part of a segment above a face, the lower first, their heights [2], and if any is.

    If none is, the points are those of the whole segment. Repeated corners of the polygon cut nothing off.
    """
    outward = jnp.cross(jnp.roll(polygon, -1, axis=0) - polygon, normal[None])
    first, last = (jnp.sum((end[None] - polygon) * outward, axis=-1) for end in ends)
    crossing = first / jnp.where(first == last, 1.0, first - last)
    enter = jnp.max(jnp.where(first > 0, crossing, 0.0), initial=0.0)
    leave = jnp.min(jnp.where(last > 0, crossing, 1.0), initial=1.0)
    above = (enter <= leave) & ~jnp.any((first > 0) & (last > 0))
    share = jnp.where(above, jnp.stack([enter, leave]), jnp.array([0.0, 1.0]))
    points = ends[:1] + share[:, None] * (ends[1] - ends[0])[None]
    heights = (points - polygon[:1]) @ normal
    order = jnp.where(heights[0] <= heights[1], jnp.array([0, 1]), jnp.array([1, 0]))
    return points[order], heights[order], above


def _distinct(points: jax.Array, ends: jax.Array) -> jax.Array:
    """Return whether two points of a segment are far enough apart to be two contacts."""
    return jnp.sum((points[1] - points[0]) ** 2) > _APART**2 * jnp.sum((ends[1] - ends[0]) ** 2)
