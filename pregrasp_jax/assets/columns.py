"""The solid under a surface, as vertical columns: what hulls are compared with.

The volume that the divergence theorem gives is wrong where surfaces cross themselves, where bodies overlap (they count
twice) and where there are holes. A column is inside where the surface winds around it, and is left out where that does
not work out. Where only the base is missing, as in scans of what stood on a table, the floor closes it.
"""

from typing import NamedTuple

import numpy as np

COLUMNS = 96
"""Columns per side of the bounding rectangle."""

_OFFSET = (0.4863, 0.5071)
"""Where in its cell a column stands: beside the middle, since edges of symmetric shapes run through that."""

_CHUNK = 2_000_000
"""Pairs of a face and a column that are tried at once; 100 MB."""


class Columns(NamedTuple):
    """A solid as columns of a grid.

    Attributes:
        length: [K] m of each column inside the solid.
        bottom: [K] m, where the surface is met first from below; infinite where it never is.
        top: [K] m, where it is met first from above; minus infinite where it never is.
        known: [K] whether the surface is closed along the column.
    """

    length: np.ndarray
    bottom: np.ndarray
    top: np.ndarray
    known: np.ndarray


def grid(lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the x [C] and y [C] of the columns of the rectangle between two corners [2]."""
    x, y = (lower[i] + (upper[i] - lower[i]) * (np.arange(COLUMNS) + _OFFSET[i]) / COLUMNS for i in range(2))
    return x, y


def cut(vertices: np.ndarray, faces: np.ndarray, x: np.ndarray, y: np.ndarray) -> Columns:
    """Cut columns out of the solid that a surface bounds.

    Args:
        vertices: [V, 3] m.
        faces: [F, 3], anticlockwise seen from outside.
        x: [C] m, evenly spaced.
        y: [C] m, evenly spaced.

    Returns:
        The columns, y running faster; where the surface winds more than once around a point, it counts once.
    """
    column, height, step = _crossings(vertices[faces], x, y)
    total = np.bincount(column, step, len(x) * len(y))
    baseless = np.flatnonzero(np.abs(total + 1) < 0.5)
    column, height = np.append(column, baseless), np.append(height, np.full(len(baseless), vertices[:, 2].min()))
    step = np.append(step, np.ones(len(baseless)))
    bottom, top = np.full(len(x) * len(y), np.inf), np.full(len(x) * len(y), -np.inf)
    np.minimum.at(bottom, column, height)
    np.maximum.at(top, column, height)
    order = np.lexsort((height, column))
    column, height, step = column[order], height[order], step[order]
    winding = np.cumsum(step)  # every closed column returns to zero; the others are corrected here
    total = np.bincount(column, step, len(x) * len(y))
    before = np.cumsum(total) - total
    winding = winding - before[column]
    span = np.diff(height, append=0.0)
    inside = (winding > 0.5) & (column == np.append(column[1:], -1))
    return Columns(np.bincount(column, span * inside, len(total)), bottom, top, np.abs(total) < 0.5)


def _crossings(triangles: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return column [N], height [N] m and step [N] (+1 into the solid, upwards) of all crossings with triangles."""
    cell = np.array([x[1] - x[0], y[1] - y[0]])
    corners = (triangles[:, :, :2] - [x[0], y[0]]) / cell
    low = np.clip(np.ceil(corners.min(axis=1)), 0, [len(x), len(y)]).astype(int)
    high = np.clip(np.floor(corners.max(axis=1)) + 1, 0, [len(x), len(y)]).astype(int)
    counts = np.maximum(high - low, 0).prod(axis=1)
    found = [(np.zeros(0, int), np.zeros(0), np.zeros(0))]
    for chunk in np.split(np.arange(len(triangles)), np.flatnonzero(np.diff(np.cumsum(counts) // _CHUNK)) + 1):
        found.append(_cross(corners[chunk], triangles[chunk, :, 2], low[chunk], high[chunk], counts[chunk], len(y)))
    column, height, step = (np.concatenate(part) for part in zip(*found, strict=True))
    return column, height, step


def _cross(
    corners: np.ndarray, heights: np.ndarray, low: np.ndarray, high: np.ndarray, counts: np.ndarray, rows: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cut columns with triangles [T, 3, 2] in cells: every face against all columns of its bounding rectangle."""
    face = np.repeat(np.arange(len(counts)), counts)
    number = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    depth = np.maximum(high[face, 1] - low[face, 1], 1)
    column = low[face] + np.column_stack([number // depth, number % depth])
    a, b, c = (corners[face, i] for i in range(3))
    weights = np.stack([_side(b, c, column), _side(c, a, column), _side(a, b, column)])
    area = weights.sum(axis=0)
    inside = (np.all(weights > 0, axis=0) | np.all(weights < 0, axis=0)) & (area != 0)
    weights, area, face, column = weights[:, inside], area[inside], face[inside], column[inside]
    height = (weights * heights[face].T).sum(axis=0) / area
    return column[:, 0] * rows + column[:, 1], height, -np.sign(area)


def _side(a: np.ndarray, b: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Return twice the signed area [N] of triangles a, b, point; the same bits, negated, for b, a."""
    swap = (a[:, 0] > b[:, 0]) | ((a[:, 0] == b[:, 0]) & (a[:, 1] > b[:, 1]))
    first, second = np.where(swap[:, None], b, a), np.where(swap[:, None], a, b)
    (dx, dy), (px, py) = (second - first).T, (point - first).T
    return np.where(swap, -1.0, 1.0) * (dx * py - dy * px)
