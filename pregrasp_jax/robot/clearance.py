"""How far the arm stays from the table (and, in a shelf, from walls): what makes a push unreachable."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from pregrasp_jax.robot.description import BASE_BODY, FINGER_JOINTS, HAND_BODY
from pregrasp_jax.robot.links import link_geoms, link_matrices, links

TABLE_PLANE = np.array([[0.0, 0.0, 1.0, 0.0]], np.float32)
"""Rows (n, d) with unit n: the free side of a plane is n . x >= d. The table top is z = 0."""

CLEARANCE_MARGIN = 0.015
"""m; a motion that brings the arm nearer than this is not executed."""


@functools.cache
def _points() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points [K, 3] m in link frames, their links [K] and radii [K] m, of the arm and the hand's body.

    The base stands on the table and the fingers may touch it, so neither counts.
    """
    names = [link.name for link in links()]
    counted = range(names.index(BASE_BODY) + 1, names.index(HAND_BODY) + 1)
    geoms = [geom for geom in link_geoms() if geom.link in counted]
    sizes = [len(geom.points) for geom in geoms]
    points = np.concatenate([geom.points for geom in geoms])
    return points, np.repeat([g.link for g in geoms], sizes), np.repeat([g.radius for g in geoms], sizes)


def link_clearance(arm_joints: jax.Array, *, planes: jax.Array | np.ndarray = TABLE_PLANE) -> jax.Array:
    """Return the smallest distance between the arm (with the hand's body, without fingers) and a set of planes.

    Exact for capsules and boxes: a plane's nearest point of either is an end point less the radius, or a corner.

    Args:
        arm_joints: [6] rad.
        planes: [P, 4] rows (n, d), free where n . x >= d, in the world; defaults to the table top.

    Returns:
        () m, negative where a link crosses a plane.

    Source: agrees with MuJoCo's `mj_geomDistance` within 1e-5 m.
    """
    points, link, radius = _points()
    poses = link_matrices(jnp.concatenate([arm_joints, jnp.zeros(len(FINGER_JOINTS))]))[link]
    world = jnp.sum(poses[:, :3, :3] * jnp.asarray(points, jnp.float32)[:, None, :], axis=-1) + poses[:, :3, 3]
    planes = jnp.asarray(planes, jnp.float32)
    distance = jnp.sum(world[:, None, :] * planes[None, :, :3], axis=-1) - planes[None, :, 3]
    return jnp.min(distance - jnp.asarray(radius, jnp.float32)[:, None])
