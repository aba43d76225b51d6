"""How far a robot stays from the table and from walls: what makes a push unreachable."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pregrasp_jax.robot.links import LinkGeom, Links
from pregrasp_jax.spaces.workspace import Box, Workspace

CLEARANCE_MARGIN = 0.015
"""m; a motion that brings the arm nearer than this to the table or to a wall is not executed."""

CHECKED_POSES = 24
"""Poses of a motion at which walls are kept clear of: 9 mm apart for the longest push of the paper. In between the hand
can come at most half of that nearer."""

_FINGER_LENGTH = 0.1
"""m, what a radian of aperture counts for in the length of a motion."""

_BOX_EDGES = np.array([(a, b) for a in range(8) for b in range(a + 1, 8) if bin(a ^ b).count("1") == 1])
"""Pairs of corners of a box that an edge joins; corners are numbered by the bits (x, y, z)."""


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


def near_walls(
    links: Links,
    geoms: Sequence[LinkGeom],
    path: jax.Array,
    poses: jax.Array,
    apertures: jax.Array,
    workspace: Workspace,
) -> jax.Array:
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
    if not workspace.walls:
        return jnp.zeros(len(path), bool)
    place = jnp.concatenate([poses[:, :3], _FINGER_LENGTH * apertures[:, None], poses[:, 3:]], axis=1)
    length = jnp.cumsum(jnp.linalg.norm(jnp.diff(place, axis=0, prepend=place[:1]), axis=1))
    shares = jnp.linspace(0.0, 1.0, CHECKED_POSES)
    rows = jnp.minimum(jnp.searchsorted(length, shares * length[-1]), len(path) - 1).at[-1].set(len(path) - 1)
    distance = jax.vmap(lambda q: distance_to_walls(links, geoms, q, workspace))(path[rows])
    return ~(distance >= CLEARANCE_MARGIN)[jnp.searchsorted(rows, jnp.arange(len(path)))]


def distance_to_walls(links: Links, geoms: Sequence[LinkGeom], joint_pos: jax.Array, workspace: Workspace) -> jax.Array:
    """Return the smallest distance () m between geoms of a robot and the walls of a workspace; inf without walls.

    Two boxes are nearest at a corner of one or at edges of both, so that the edges of either against the other are
    enough. Overlap gives 0 or less.

    Source: agrees with MuJoCo's `mj_geomDistance` within 1e-4 m where nothing overlaps.
    """
    walls = workspace.walls
    if not walls:
        return jnp.float32(jnp.inf)
    matrices = links.matrices(joint_pos)
    into_wall = np.stack([_inverse_pose(wall) for wall in walls])
    half_sizes = np.array([wall.half_size for wall in walls]).T
    axes = [geom.points[None] if len(geom.points) == 2 else geom.points[_BOX_EDGES] for geom in geoms]
    sizes = [len(axis) for axis in axes]
    link, radius = (np.repeat([getattr(geom, name) for geom in geoms], sizes) for name in ("link", "radius"))
    ends = _moved(matrices[link][:, None], np.concatenate(axes))
    beside = _box_distance(_moved(into_wall[:, None, None], ends[None]), half_sizes[:, :, None])
    found = [beside - jnp.asarray(radius, jnp.float32)[None]]
    if boxes := [_box_of(geom) for geom in geoms if len(geom.points) == 8]:
        edges = np.stack([wall.corners()[_BOX_EDGES] for wall in walls])[None]
        into_link = _inverse(matrices[np.array([box.link for box in boxes])])[:, None, None, None]
        into_box = np.stack([box.from_link for box in boxes])[:, None, None, None]
        sides = np.stack([box.half_size for box in boxes], axis=1)
        found.append(_box_distance(_moved(into_box, _moved(into_link, edges)), sides[:, :, None, None]))
    return jnp.min(jnp.concatenate([distance.ravel() for distance in found]))


def _box_distance(ends: jax.Array, half_size: np.ndarray) -> jax.Array:
    """Return the distances [...] m from segments [..., 2, 3] to boxes about the origin, of half size [3, ...].

    Along a segment the squared distance is convex and made of parabolas that meet where the segment crosses the plane
    of a face. Its slope is linear between the two of these places around the nearest point, and 0 there. Coordinates
    are taken one by one, because XLA makes one fast loop of what has no short axes.
    """
    start = [ends[..., 0, axis] for axis in range(3)]
    along = [ends[..., 1, axis] - ends[..., 0, axis] for axis in range(3)]
    half = [jnp.asarray(half_size[axis], jnp.float32) for axis in range(3)]

    def beyond(share: jax.Array, axis: int) -> jax.Array:
        point = start[axis] + share * along[axis]
        return point - jnp.clip(point, -half[axis], half[axis])

    zero = jnp.zeros_like(start[0])
    shares = [zero, zero + 1]
    for axis in range(3):
        pace = jnp.where(along[axis] == 0, 1.0, along[axis])
        shares += [jnp.clip((side * half[axis] - start[axis]) / pace, 0.0, 1.0) for side in (-1, 1)]
    low, down, high, up = zero, zero - jnp.inf, zero + 1, zero + jnp.inf
    for share in shares:
        slope = sum((beyond(share, axis) * along[axis] for axis in range(3)), zero)
        falls, rises = slope <= 0, slope >= 0
        low, down = (jnp.where(falls, jnp.maximum(a, b), a) for a, b in ((low, share), (down, slope)))
        high, up = (jnp.where(rises, jnp.minimum(a, b), a) for a, b in ((high, share), (up, slope)))
    # If it only falls, the end is nearest (`high` is 1); if it only rises, the start (`low` is 0).
    between = jnp.isfinite(down) & jnp.isfinite(up) & (down < up)
    rise = jnp.where(between, up - down, 1.0)
    nearest = jnp.where(between, low - (high - low) * down / rise, jnp.where(jnp.isinf(up), high, low))
    return jnp.sqrt(sum((beyond(nearest, axis) ** 2 for axis in range(3)), zero))


def _moved(matrices: jax.Array | np.ndarray, points: jax.Array | np.ndarray) -> jax.Array:
    """Return points [..., 3] moved by matrices [..., 4, 4], in full float32; leading axes broadcast."""
    matrices, points = jnp.asarray(matrices, jnp.float32), jnp.asarray(points, jnp.float32)
    moved = [
        sum((matrices[..., row, axis] * points[..., axis] for axis in range(3)), matrices[..., row, 3])
        for row in range(3)
    ]
    return jnp.stack(moved, axis=-1)


def _inverse(matrices: jax.Array) -> jax.Array:
    """Return the inverses of rigid motions [B, 4, 4]."""
    turn = jnp.swapaxes(matrices[:, :3, :3], 1, 2)
    shift = -jnp.sum(turn * matrices[:, None, :3, 3], axis=-1)
    return jnp.zeros_like(matrices).at[:, :3, :3].set(turn).at[:, :3, 3].set(shift).at[:, 3, 3].set(1.0)


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
