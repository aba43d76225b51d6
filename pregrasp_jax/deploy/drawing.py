"""Convex hulls as a depth camera sees them, in numpy.

A second implementation of `heightmap.rasterizer` (a loop that XLA makes fast), tested against it: the outline of a
hull's projection says which pixels it covers, and on these its nearest face counts.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from pregrasp_jax.deploy.camera import PinholeCamera
from pregrasp_jax.deploy.view import View
from pregrasp_jax.robot.chain import Links

NEAR = 0.1
"""m; a camera sees nothing nearer."""

_FACING = 1e-6
"""Faces whose plane is nearer to the camera than this, m, are seen edge on."""


class WorldHull(NamedTuple):
    """A hull placed in the world.

    Attributes:
        vertices: [V, 3] m.
        planes: [F, 4], inside iff n . x <= d.
    """

    vertices: np.ndarray
    planes: np.ndarray


class DrawnHull(NamedTuple):
    """The pixels that a hull covers, in the cut image.

    Attributes:
        rows: [P] int.
        columns: [P] int.
        depth: [P] float32 m.
    """

    rows: np.ndarray
    columns: np.ndarray
    depth: np.ndarray


def link_hulls(links: Links, joint_pos: np.ndarray) -> list[WorldHull]:
    """Return the hulls of all links for joints [J]."""
    matrices = links.matrices(np.asarray(joint_pos, np.float64))
    placed = []
    for link, vertices, planes in zip(links.hull_links, links.hulls.vertices, links.hulls.planes, strict=True):
        turn, place = matrices[link, :3, :3], matrices[link, :3, 3]
        normals = planes[:, :3] @ turn.T
        placed.append(
            WorldHull(
                vertices @ turn.T + place,
                np.concatenate([normals, planes[:, 3:] + (normals @ place)[:, None]], axis=1),
            )
        )
    return placed


def draw_hulls(hulls: list[WorldHull], view: View) -> Iterator[DrawnHull]:
    """Yield what is seen of every hull that reaches into the cut image. A hull nearer than `NEAR` is not drawn."""
    corner = np.array([view.columns.start, view.rows.start])
    size = np.array([view.columns.stop, view.rows.stop]) - corner
    for hull in hulls:
        pixels, depth = view.camera.project(hull.vertices)
        pixels = pixels - corner
        if depth.min() < NEAR or (pixels.max(axis=0) < 0).any() or (pixels.min(axis=0) > size - 1).any():
            continue
        rows, columns = _covered(_outline(pixels), size)
        if rows.size:
            yield DrawnHull(rows, columns, _depth(hull.planes, view.rays[:, rows, columns], view.camera))


def _outline(points: np.ndarray) -> np.ndarray:
    """Return the convex outline [P, 2] of points [V, 2], counter-clockwise in (x, y), by Andrew's monotone chain."""
    ordered = sorted(set(map(tuple, points.tolist())))

    def half(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
        chain: list[tuple[float, float]] = []
        for x, y in points:
            while len(chain) >= 2:
                (ax, ay), (bx, by) = chain[-2:]
                if (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0:
                    break
                chain.pop()
            chain.append((x, y))
        return chain[:-1]

    return np.array(half(ordered) + half(ordered[::-1]))


def _covered(outline: np.ndarray, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns [P] of the pixels of an image of size (columns, rows) inside a convex outline."""
    first = max(int(np.ceil(outline[:, 1].min())), 0)
    last = min(int(np.floor(outline[:, 1].max())), int(size[1]) - 1)
    rows = np.arange(first, last + 1)
    if len(outline) < 3 or rows.size == 0:
        return np.empty(0, int), np.empty(0, int)
    (xa, ya), (xb, yb) = outline.T, np.roll(outline, -1, axis=0).T
    level = ya == yb
    share = (rows[:, None] - ya) / np.where(level, 1.0, yb - ya)
    crossed = ~level & (rows[:, None] >= np.minimum(ya, yb)) & (rows[:, None] <= np.maximum(ya, yb))
    x = xa + share * (xb - xa)
    left = np.where(crossed, x, np.inf).min(axis=1)
    right = np.where(crossed, x, -np.inf).max(axis=1)
    found = np.isfinite(left) & np.isfinite(right)
    start = np.maximum(np.ceil(np.where(found, left, 0)).astype(int), 0)
    stop = np.minimum(np.floor(np.where(found, right, -1)).astype(int), int(size[0]) - 1)
    count = np.maximum(np.where(found, stop - start + 1, 0), 0)
    ends = np.cumsum(count)
    columns = np.arange(ends[-1]) - np.repeat(ends - count - start, count)
    return np.repeat(rows, count), columns


def _depth(planes: np.ndarray, rays: np.ndarray, camera: PinholeCamera) -> np.ndarray:
    """Return the depth [P] m at which rays [3, P] from the camera enter a hull: behind the last face that they meet.

    A ray meets the plane n . x = d at (d - n . camera) / (n . ray); of the faces that look at the camera the farthest
    counts.
    """
    offset = planes[:, 3] - planes[:, :3] @ camera.world_from_optical[:3, 3]
    facing = offset < -_FACING
    normals = (planes[facing, :3] / offset[facing, None]).astype(np.float32)
    return 1 / (np.unique(normals, axis=0) @ rays).min(axis=0)
