"""How far a robot stays from the table and from walls: what makes a push unreachable. For numpy and jax alike."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from pregrasp_jax.geometry import of_rows, rigid_inverse
from pregrasp_jax.robot.chain import LinkGeom, Links
from pregrasp_jax.spaces.arrays import namespace
from pregrasp_jax.spaces.workspace import Box, Workspace

Array = Any

CLEARANCE_MARGIN = 0.015
"""m; a motion that brings the arm nearer than this to the table or to a wall is not executed."""

CHECKED_POSES = 24
"""Poses of a motion at which walls are kept clear of: 9 mm apart for the longest push of the paper. In between the hand
can come at most half of that nearer."""

_FINGER_LENGTH = 0.1
"""m, what a radian of aperture counts for in the length of a motion."""

_BOX_EDGES = np.array([(a, b) for a in range(8) for b in range(a + 1, 8) if bin(a ^ b).count("1") == 1])
"""Pairs of corners of a box that an edge joins; corners are numbered by the bits (x, y, z)."""


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


def near_walls(
    links: Links,
    geoms: Sequence[LinkGeom],
    path: Array,
    poses: Array,
    apertures: Array,
    workspace: Workspace,
) -> Array:
    """Return [T] bool, whether a motion brings geoms of a robot nearer to walls than `CLEARANCE_MARGIN`.

    Distances are measured at `CHECKED_POSES` rows, spread evenly over the length of the motion; a row in between is as
    near as the next of these.

    Args:
        links: of the robot.
        geoms: what must keep clear.
        path: [T, J] joint positions.
        poses: [T, 7] of the grasp point.
        apertures: [T].
        workspace: the walls.
    """
    xp, last = namespace(path), len(path) - 1
    if not workspace.walls:
        return xp.zeros(len(path), bool)
    place = xp.concatenate([poses[:, :3], _FINGER_LENGTH * apertures[:, None], poses[:, 3:]], axis=1)
    length = xp.cumsum(xp.linalg.norm(xp.diff(place, axis=0, prepend=place[:1]), axis=1))
    shares = xp.linspace(0.0, 1.0, CHECKED_POSES)
    rows = xp.minimum(xp.searchsorted(length, shares * length[-1]), last)
    rows = xp.where(xp.arange(CHECKED_POSES) == CHECKED_POSES - 1, last, rows)
    distance = of_rows(lambda row: distance_to_walls(links, geoms, row, workspace), path[rows])
    return ~(distance >= CLEARANCE_MARGIN)[xp.searchsorted(rows, xp.arange(len(path)))]


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
    xp, walls, batch = namespace(joint_pos), workspace.walls, joint_pos.shape[:-1]
    if not walls:
        return xp.full(batch, xp.inf, xp.float32)
    matrices = links.matrices(joint_pos)
    into_wall = xp.asarray(np.stack([_inverse_pose(wall) for wall in walls]), xp.float32)
    half_sizes = np.array([wall.half_size for wall in walls]).T
    axes = [geom.points[None] if len(geom.points) == 2 else geom.points[_BOX_EDGES] for geom in geoms]
    sizes = [len(axis) for axis in axes]
    link, radius = (np.repeat([getattr(geom, name) for geom in geoms], sizes) for name in ("link", "radius"))
    ends = _moved(matrices[..., link, None, :, :], np.concatenate(axes))
    beside = _box_distance(_moved(into_wall[:, None, None], ends[..., None, :, :, :]), half_sizes[:, :, None])
    found = [beside - xp.asarray(radius, xp.float32)[None]]
    if boxes := [_box_of(geom) for geom in geoms if len(geom.points) == 8]:
        edges = np.stack([wall.corners()[_BOX_EDGES] for wall in walls])[None]
        into_link = rigid_inverse(matrices[..., [box.link for box in boxes], :, :])[..., None, None, None, :, :]
        into_box = xp.asarray(np.stack([box.from_link for box in boxes])[:, None, None, None], xp.float32)
        sides = np.stack([box.half_size for box in boxes], axis=1)
        found.append(_box_distance(_moved(into_box, _moved(into_link, edges)), sides[:, :, None, None]))
    return xp.min(xp.concatenate([distance.reshape(*batch, -1) for distance in found], axis=-1), axis=-1)


def _box_distance(ends: Array, half_size: np.ndarray) -> Array:
    """Return the distances [...] m from segments [..., 2, 3] to boxes about the origin, of half size [3, ...].

    Along a segment the squared distance is convex and made of parabolas that meet where the segment crosses the plane
    of a face. Its slope is linear between the two of these places around the nearest point, and 0 there. Coordinates
    are taken one by one, because XLA makes one fast loop of what has no short axes.
    """
    xp = namespace(ends)
    start = [ends[..., 0, axis] for axis in range(3)]
    along = [ends[..., 1, axis] - ends[..., 0, axis] for axis in range(3)]
    half = [xp.asarray(half_size[axis], xp.float32) for axis in range(3)]

    def beyond(share: Array, axis: int) -> Array:
        point = start[axis] + share * along[axis]
        return point - xp.clip(point, -half[axis], half[axis])

    zero = xp.zeros_like(start[0])
    shares = [zero, zero + 1]
    for axis in range(3):
        pace = xp.where(along[axis] == 0, 1.0, along[axis])
        shares += [xp.clip((side * half[axis] - start[axis]) / pace, 0.0, 1.0) for side in (-1, 1)]
    low, down, high, up = zero, zero - xp.inf, zero + 1, zero + xp.inf
    for share in shares:
        slope = sum((beyond(share, axis) * along[axis] for axis in range(3)), zero)
        falls, rises = slope <= 0, slope >= 0
        low, down = (xp.where(falls, xp.maximum(a, b), a) for a, b in ((low, share), (down, slope)))
        high, up = (xp.where(rises, xp.minimum(a, b), a) for a, b in ((high, share), (up, slope)))
    # If it only falls, the end is nearest (`high` is 1); if it only rises, the start (`low` is 0).
    between = xp.isfinite(down) & xp.isfinite(up) & (down < up)
    fall, rise = xp.where(between, down, 0.0), xp.where(between, up - down, 1.0)
    nearest = xp.where(between, low - (high - low) * fall / rise, xp.where(xp.isinf(up), high, low))
    return xp.sqrt(sum((beyond(nearest, axis) ** 2 for axis in range(3)), zero))


def _moved(matrices: Array, points: Array) -> Array:
    """Return points [..., 3] moved by matrices [..., 4, 4], in full float32; leading axes broadcast."""
    xp = namespace(matrices, points)
    matrices, points = xp.asarray(matrices, xp.float32), xp.asarray(points, xp.float32)
    moved = [
        sum((matrices[..., row, axis] * points[..., axis] for axis in range(3)), matrices[..., row, 3])
        for row in range(3)
    ]
    return xp.stack(moved, axis=-1)


def _inverse_pose(wall: Box) -> np.ndarray:
    """Return the motion [4, 4] from the world into a wall's own frame."""
    cos, sin = np.cos(wall.yaw), np.sin(wall.yaw)
    turn = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn, -turn @ wall.center
    return matrix


class _LinkBox(NamedTuple):
    """A box of a robot.

    Attributes:
        link: index into `Links.names`.
        from_link: [4, 4] motion from the link's frame into that of the box.
        half_size: [3] m.
    """

    link: int
    from_link: np.ndarray
    half_size: np.ndarray


def _box_of(geom: LinkGeom) -> _LinkBox:
    """Return a box from its corners."""
    corners = geom.points
    edges = np.stack([corners[4] - corners[0], corners[2] - corners[0], corners[1] - corners[0]])
    lengths = np.linalg.norm(edges, axis=1)
    from_link = np.eye(4)
    from_link[:3, :3] = edges / lengths[:, None]
    from_link[:3, 3] = -from_link[:3, :3] @ corners.mean(axis=0)
    return _LinkBox(geom.link, from_link, lengths / 2)
