"""Contacts between a plane and a convex hull, and how a few points are chosen from many on one side of a plane."""

import jax
import jax.numpy as jnp
from mujoco.mjx._src import collision_convex
from mujoco.mjx._src.collision_types import ConvexInfo, GeomInfo

NO_CONTACT = 1.0
"""m; distance of a contact that does not exist, as in MJX."""


def plane_hull(plane: GeomInfo, hull: ConvexInfo) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return dist [4], pos [4, 3] and normal [4, 3] of a hull on a plane: vertices within 1 mm of the lowest, spread.

    Source: agrees with `mjc_PlaneConvex` on the deepest point within 1e-6 m (tests/test_mjx.py).
    """
    normal = plane.mat[:, 2]
    points = hull.pos[None] + hull.vert @ hull.mat.T
    depth = (plane.pos[None] - points) @ normal
    chosen, distinct = spread(points, depth, depth > jnp.maximum(0, depth.max() - 1e-3), normal)
    dist = jnp.where(distinct, -depth[chosen], NO_CONTACT)
    return dist, points[chosen] - 0.5 * dist[:, None] * normal[None], jnp.tile(normal, (4, 1))


def spread(points: jax.Array, depth: jax.Array, mask: jax.Array, normal: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return four indices of masked points [n, 3] that span much area, the deepest first, and which are distinct.

    MJX's own choice starts at the first point of the mask, so the points are turned until that is the deepest.
    """
    count = len(points)
    turned = (jnp.arange(count) + jnp.argmax(jnp.where(mask, depth, -jnp.inf))) % count
    chosen = turned[collision_convex._manifold_points(points[turned], mask[turned], normal)]
    repeated = jnp.any((chosen[:, None] == chosen[None]) & jnp.tri(4, k=-1, dtype=bool), axis=1)
    return chosen, mask[chosen] & ~repeated
