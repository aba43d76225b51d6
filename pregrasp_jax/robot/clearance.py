"""How far a robot stays from the table and from walls: what makes a push unreachable. For numpy and jax alike."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from pregrasp_jax.geometry import repeat, rigid_inverse
from pregrasp_jax.robot.chain import LinkGeom, Links
from pregrasp_jax.spaces.arrays import namespace
from pregrasp_jax.spaces.workspace import Box, Workspace

Array = Any

CLEARANCE_MARGIN = 0.015
"""m; a motion that brings the arm nearer than this to the table or to a wall is not executed."""

_BOX_EDGES = np.array([(a, b) for a in range(8) for b in range(a + 1, 8) if bin(a ^ b).count("1") == 1])
"""Pairs of corners of a box that an edge joins; corners are numbered by the bits (x, y, z)."""

_STEPS = 32
"""Of the search along a segment, each of which leaves two thirds; 1 m shrinks to 2 um."""


def height_above_table(links: Links, geoms: Sequence[LinkGeom], joint_pos: Array) -> Array:
    """Return the smallest height [...] m of geoms of a robot above the table, z = 0; negative where one is below.

    Exact for capsules and boxes: the lowest point of either is an end point less the radius, or a corner.

    Args:
        links: of the robot.
        geoms: those that count.
        joint_pos: [..., J].

    Source: agrees with MuJoCo's `mj_geomDistance` within 1e-5 m.
    """
    xp = namespace(joint_pos)
    sizes = [len(geom.points) for geom in geoms]
    points = xp.asarray(np.concatenate([geom.points for geom in geoms]), xp.float32)
    link = np.repeat([geom.link for geom in geoms], sizes)
    radius = xp.asarray(np.repeat([geom.radius for geom in geoms], sizes), xp.float32)
    poses = links.matrices(joint_pos)[..., link, 2, :]
    height = xp.sum(poses[..., :3] * points, axis=-1) + poses[..., 3]
    return xp.min(height - radius, axis=-1)


def distance_to_walls(links: Links, geoms: Sequence[LinkGeom], joint_pos: Array, workspace: Workspace) -> Array:
    """Return the smallest distance [...] m between geoms of a robot and the walls of a workspace; inf without walls.

    Two boxes are nearest at a corner of one or at edges of both, so that the edges of either against the other are
    enough. Overlap gives 0 or less.

    Args:
        links: of the robot.
        geoms: those that count.
        joint_pos: [..., J].
        workspace: its walls.

    Source: agrees with MuJoCo's `mj_geomDistance` within 1e-4 m where nothing overlaps.
    """
    xp = namespace(joint_pos)
    if not workspace.walls:
        return xp.full(joint_pos.shape[:-1], xp.inf, xp.float32)
    matrices = links.matrices(joint_pos)
    axes = [geom.points[None] if len(geom.points) == 2 else geom.points[_BOX_EDGES] for geom in geoms]
    sizes = [len(axis) for axis in axes]
    link = np.repeat([geom.link for geom in geoms], sizes)
    radius = xp.asarray(np.repeat([geom.radius for geom in geoms], sizes), xp.float32)
    ends = _moved(matrices[..., link, :, :], np.concatenate(axes))
    boxes = [geom for geom in geoms if len(geom.points) == 8]
    found = []
    for wall in workspace.walls:
        into_wall = xp.asarray(_inverse_pose(wall), xp.float32)
        found.append(_box_distance(_moved(into_wall[None], ends), np.array(wall.half_size)) - radius)
        edges = wall.corners()[_BOX_EDGES]
        for geom in boxes:
            centre, turn, half_size = _box_of(geom)
            in_link = _moved(rigid_inverse(matrices[..., geom.link, :, :])[..., None, :, :], edges)
            local = _moved(_into(turn, centre)[None], in_link)
            found.append(_box_distance(local, half_size))
    return xp.min(xp.concatenate(found, axis=-1), axis=-1)


def _box_distance(ends: Array, half_size: np.ndarray) -> Array:
    """Return the distances [..., S] m from segments [..., S, 2, 3] to a box about the origin.

    The distance is convex along a segment, so that the nearest point is found by thirds.
    """
    xp = namespace(ends)
    start, along = ends[..., 0, :], ends[..., 1, :] - ends[..., 0, :]
    size = xp.asarray(half_size, xp.float32).reshape((1,) * (start.ndim - 1) + (3,))

    def distance(share: Array) -> Array:
        point = start + share[..., None] * along
        return xp.linalg.norm(xp.maximum(xp.abs(point) - size, 0.0), axis=-1)

    def narrow(interval: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = interval
        third = (high - low) / 3
        left = distance(low + third) <= distance(high - third)
        return xp.where(left, low, low + third), xp.where(left, high - third, high)

    zero = xp.zeros_like(start[..., 0])
    low, high = repeat(_STEPS, narrow, (zero, zero + 1))
    return xp.minimum(distance((low + high) / 2), xp.minimum(distance(zero), distance(zero + 1)))


def _moved(matrices: Array, points: Array) -> Array:
    """Return points [..., S, 2, 3] moved by matrices [..., S, 4, 4] (or one for all S), in full float32."""
    xp = namespace(matrices, points)
    matrices, points = xp.asarray(matrices, xp.float32), xp.asarray(points, xp.float32)
    matrices = matrices[..., None, :, :]
    turned = xp.sum(matrices[..., :3, :3] * points[..., None, :], axis=-1)
    return turned + matrices[..., :3, 3]


def _inverse_pose(wall: Box) -> np.ndarray:
    """Return the motion [4, 4] from the world into a wall's own frame."""
    cos, sin = np.cos(wall.yaw), np.sin(wall.yaw)
    turn = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return _into(turn.T, np.array(wall.center))


def _into(axes: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Return the motion [4, 4] into a frame with such axes [3, 3], as columns, and such an origin [3] m."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = axes.T, -axes.T @ centre
    return matrix


def _box_of(geom: LinkGeom) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the centre [3], the axes [3, 3] as columns, and the half sizes [3] m of a box from its corners."""
    corners = geom.points
    edges = np.stack([corners[4] - corners[0], corners[2] - corners[0], corners[1] - corners[0]])
    lengths = np.linalg.norm(edges, axis=1)
    return corners.mean(axis=0), (edges / lengths[:, None]).T, lengths / 2
