"""How far a robot stays from the table and from walls: what makes a push unreachable."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from pregrasp_jax.robot.links import LinkGeom, Links
from pregrasp_jax.spaces.workspace import Box, Workspace

CLEARANCE_MARGIN = 0.015
"""m; a motion that brings the arm nearer than this to the table or to a wall is not executed."""

_BOX_EDGES = np.array([(a, b) for a in range(8) for b in range(a + 1, 8) if bin(a ^ b).count("1") == 1])
"""Pairs of corners of a box that an edge joins; corners are numbered by the bits (x, y, z)."""

_STEPS = 32
"""Of the search along a segment, each of which leaves two thirds; 1 m shrinks to 2 um."""


def height_above_table(links: Links, geoms: Sequence[LinkGeom], joint_pos: jax.Array) -> jax.Array:
    """Return the smallest height () m of geoms of a robot above the table, z = 0; negative where one is below.

    Exact for capsules and boxes: the lowest point of either is an end point less the radius, or a corner.

    Source: agrees with MuJoCo's `mj_geomDistance` within 1e-5 m.
    """
    sizes = [len(geom.points) for geom in geoms]
    points = jnp.asarray(np.concatenate([geom.points for geom in geoms]), jnp.float32)
    link = np.repeat([geom.link for geom in geoms], sizes)
    radius = np.repeat([geom.radius for geom in geoms], sizes)
    poses = links.matrices(joint_pos)[link]
    height = jnp.sum(poses[:, 2, :3] * points, axis=-1) + poses[:, 2, 3]
    return jnp.min(height - jnp.asarray(radius, jnp.float32))


def distance_to_walls(links: Links, geoms: Sequence[LinkGeom], joint_pos: jax.Array, workspace: Workspace) -> jax.Array:
    """Return the smallest distance () m between geoms of a robot and the walls of a workspace; inf without walls.

    Two boxes are nearest at a corner of one or at edges of both, so that the edges of either against the other are
    enough. Overlap gives 0 or less.

    Source: agrees with MuJoCo's `mj_geomDistance` within 1e-4 m where nothing overlaps.
    """
    if not workspace.walls:
        return jnp.float32(jnp.inf)
    matrices = links.matrices(joint_pos)
    axes = [geom.points[None] if len(geom.points) == 2 else geom.points[_BOX_EDGES] for geom in geoms]
    sizes = [len(axis) for axis in axes]
    link = np.repeat([geom.link for geom in geoms], sizes)
    radius = jnp.asarray(np.repeat([geom.radius for geom in geoms], sizes), jnp.float32)
    ends = _moved(matrices[link], np.concatenate(axes))
    boxes = [geom for geom in geoms if len(geom.points) == 8]
    found = []
    for wall in workspace.walls:
        into_wall = _inverse_pose(wall)
        found.append(_box_distance(_moved(into_wall[None], ends), np.array(wall.half_size)) - radius)
        edges = jnp.asarray(wall.corners()[_BOX_EDGES], jnp.float32)
        for geom in boxes:
            centre, axes, half_size = _box_of(geom)
            in_link = _moved(_inverse(matrices[geom.link]), edges)
            found.append(_box_distance(jnp.matmul(in_link - centre[None, None], axes, precision="highest"), half_size))
    return jnp.min(jnp.concatenate(found))


def _box_distance(ends: jax.Array, half_size: np.ndarray) -> jax.Array:
    """Return the distances [S] m from segments [S, 2, 3] to a box about the origin.

    The distance is convex along a segment, so that the nearest point is found by thirds.
    """
    start, along = ends[:, 0], ends[:, 1] - ends[:, 0]

    def distance(share: jax.Array) -> jax.Array:
        point = start + share[:, None] * along
        return jnp.linalg.norm(jnp.maximum(jnp.abs(point) - jnp.asarray(half_size, jnp.float32)[None], 0.0), axis=-1)

    def narrow(_: int, interval: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        low, high = interval
        third = (high - low) / 3
        left = distance(low + third) <= distance(high - third)
        return jnp.where(left, low, low + third), jnp.where(left, high - third, high)

    zero = jnp.zeros(len(ends))
    low, high = jax.lax.fori_loop(0, _STEPS, narrow, (zero, zero + 1))
    return jnp.minimum(distance((low + high) / 2), jnp.minimum(distance(zero), distance(zero + 1)))


def _moved(matrices: jax.Array | np.ndarray, points: jax.Array | np.ndarray) -> jax.Array:
    """Return points [..., 2, 3] moved by matrices [..., 4, 4], in full float32."""
    matrices, points = jnp.asarray(matrices, jnp.float32), jnp.asarray(points, jnp.float32)
    matrices = jnp.expand_dims(matrices, tuple(range(points.ndim - matrices.ndim)))
    turned = jnp.sum(matrices[..., None, :3, :3] * points[..., None, :], axis=-1)
    return turned + matrices[..., None, :3, 3]


def _inverse(matrix: jax.Array) -> jax.Array:
    """Return the inverse of a rigid motion [4, 4]."""
    turn = matrix[:3, :3].T
    return jnp.eye(4).at[:3, :3].set(turn).at[:3, 3].set(-jnp.sum(turn * matrix[None, :3, 3], axis=-1))


def _inverse_pose(wall: Box) -> np.ndarray:
    """Return the motion [4, 4] from the world into a wall's own frame."""
    cos, sin = np.cos(wall.yaw), np.sin(wall.yaw)
    turn = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn, -turn @ wall.center
    return matrix


def _box_of(geom: LinkGeom) -> tuple[jax.Array, jax.Array, np.ndarray]:
    """Return the centre [3], the axes [3, 3] as columns, and the half sizes [3] m of a box from its corners."""
    corners = geom.points
    edges = np.stack([corners[4] - corners[0], corners[2] - corners[0], corners[1] - corners[0]])
    lengths = np.linalg.norm(edges, axis=1)
    axes = (edges / lengths[:, None]).T
    return jnp.asarray(corners.mean(axis=0), jnp.float32), jnp.asarray(axes, jnp.float32), lengths / 2
