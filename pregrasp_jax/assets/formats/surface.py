"""What every format is read into: a triangle surface, from polygons that need not be convex."""

from typing import NamedTuple

import mapbox_earcut
import numpy as np

_FLAT = 1e-9
"""Share of a polygon's squared size below which a corner is flat: straight, folded back, or a repeated point."""


class Surface(NamedTuple):
    """Triangles as a file holds them, in its own units and axes.

    Attributes:
        vertices: [V, 3] float64.
        faces: [F, 3] int.
        up: the axis that the format itself says points up, None where it says nothing.
    """

    vertices: np.ndarray
    faces: np.ndarray
    up: str | None = None


def join(surfaces: list[Surface], up: str | None = None) -> Surface:
    """Return several surfaces as one."""
    if not surfaces:
        return Surface(np.zeros((0, 3)), np.zeros((0, 3), int), up)
    starts = np.cumsum([0] + [len(surface.vertices) for surface in surfaces[:-1]])
    faces = [surface.faces + start for surface, start in zip(surfaces, starts, strict=True)]
    return Surface(np.concatenate([surface.vertices for surface in surfaces]), np.concatenate(faces), up)


def from_polygons(vertices: np.ndarray, sizes: np.ndarray, corners: np.ndarray) -> Surface:
    """Triangulate the faces of a file.

    Args:
        vertices: [V, 3].
        sizes: [P] corners of each polygon; those of fewer than three are points and lines, which are left out.
        corners: [sum of sizes] vertex indices.

    Raises:
        ValueError: a polygon names a vertex that is not there.
    """
    vertices, sizes, corners = np.asarray(vertices, np.float64), np.asarray(sizes, int), np.asarray(corners, int)
    wrong = corners[(corners < 0) | (corners >= len(vertices))]
    if wrong.size:
        raise ValueError(f"a face names vertex {wrong[0]} (from 0); allowed are the {len(vertices)} of the file")
    starts = np.cumsum(sizes) - sizes
    faces = [np.zeros((0, 3), int)]
    for size in np.unique(sizes[sizes >= 3]):
        polygons = corners[starts[sizes == size][:, None] + np.arange(size)]
        simple = np.ones(len(polygons), bool) if size == 3 else _is_convex(vertices[polygons])
        fan = np.arange(1, size - 1)
        faces.append(polygons[simple][:, np.column_stack([0 * fan, fan, fan + 1])].reshape(-1, 3))
        faces += [_cut_ears(vertices, polygon) for polygon in polygons[~simple]]
    return Surface(vertices, np.concatenate(faces))


def from_strips(vertices: np.ndarray, strips: list[np.ndarray]) -> Surface:
    """Unroll triangle strips, every other triangle of which is wound the other way round.

    Raises:
        ValueError: a strip names a vertex that is not there.
    """
    faces = [np.zeros((0, 3), int)]
    for strip in strips:
        triangles = np.lib.stride_tricks.sliding_window_view(strip, 3).copy() if len(strip) >= 3 else faces[0].copy()
        triangles[1::2] = triangles[1::2, ::-1]
        faces.append(triangles)
    corners = np.concatenate(faces)
    return from_polygons(vertices, np.full(len(corners), 3), corners.ravel())


def _newell(points: np.ndarray) -> np.ndarray:
    """Return the area vectors [..., 3] of polygons [..., N, 3]; they hold for bent and concave ones too."""
    centred = points - points.mean(axis=-2, keepdims=True)
    return np.cross(centred, np.roll(centred, -1, axis=-2)).sum(axis=-2) / 2


def _is_convex(points: np.ndarray) -> np.ndarray:
    """Tell which polygons [P, N, 3] turn the same way at every corner, so that a fan is right."""
    with np.errstate(invalid="ignore"):  # corners that are not finite are refused later, where all of them are counted
        ahead, behind = np.roll(points, -1, axis=1) - points, points - np.roll(points, 1, axis=1)
        area = _newell(points)
        turns = np.einsum("pnk,pk->pn", np.cross(behind, ahead), area)
        turning = (turns > _FLAT * (area**2).sum(axis=1, keepdims=True)).all(axis=1)
        # A star turns left at every corner too, but goes around more than once.
        cosines = (behind * ahead).sum(axis=2) / np.maximum(
            np.linalg.norm(behind, axis=2) * np.linalg.norm(ahead, axis=2), 1e-300
        )
        return turning & (np.arccos(np.clip(cosines, -1.0, 1.0)).sum(axis=1) < 3 * np.pi)


def _cut_ears(vertices: np.ndarray, polygon: np.ndarray) -> np.ndarray:
    """Triangulate one polygon [N] in the plane that fits it best, using every corner."""
    points = vertices[polygon]
    normal = _newell(points)
    if not np.isfinite(points).all() or not np.linalg.norm(normal) > 0:
        return np.column_stack([np.full(len(polygon) - 2, polygon[0]), polygon[1:-1], polygon[2:]])
    drop = int(np.argmax(np.abs(normal)))
    flat = np.delete(points - points.mean(axis=0), drop, axis=1)
    flat = flat[:, ::-1] if (normal[drop] < 0) != (drop == 1) else flat
    triangles = mapbox_earcut.triangulate_float64(np.ascontiguousarray(flat), np.array([len(flat)], np.uint32)).reshape(
        -1, 3
    )
    return polygon[_through_all_corners(flat, _anticlockwise(flat, triangles))]


def _anticlockwise(flat: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    a, b, c = (flat[triangles[:, i]] for i in range(3))
    clockwise = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0] < 0
    return np.where(clockwise[:, None], triangles[:, ::-1], triangles).astype(int)


def _through_all_corners(flat: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Split triangles [T, 3] at corners [N, 2] that lie on their edges.

    Ear cutting leaves out corners on straight edges; the faces beyond the edge use them, and a crack would open.
    """
    todo, done = [tuple(int(i) for i in triangle) for triangle in triangles], []
    size = np.ptp(flat, axis=0).max()
    while todo:
        triangle = todo.pop()
        for a, b, c in (triangle, triangle[1:] + triangle[:1], triangle[2:] + triangle[:2]):
            if (middle := _corner_between(flat, a, b, c, size)) is not None:
                todo += [(a, middle, c), (middle, b, c)]
                break
        else:
            done.append(triangle)
    return np.array(done, int).reshape(-1, 3)


def _corner_between(flat: np.ndarray, a: int, b: int, c: int, size: float) -> int | None:
    """Return a corner that lies inside the edge from a to b of the triangle a, b, c, if there is one."""
    edge = flat[b] - flat[a]
    length = np.hypot(*edge)
    if length <= 1e-6 * size:
        return None
    along = (flat - flat[a]) @ edge / length
    beside = ((flat - flat[a]) @ [-edge[1], edge[0]]) / length
    found = np.flatnonzero((np.abs(beside) < 1e-7 * size) & (along > 1e-6 * size) & (along < length - 1e-6 * size))
    return next((int(i) for i in found if i not in (a, b, c)), None)
