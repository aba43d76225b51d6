"""What an object measures: mass properties, narrowest width, and its vertical projection.

All of it is computed from the hulls, as their union: overlap between hulls counts once.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import ConvexHull

from pregrasp_jax.geometry import vertical_interval
from pregrasp_jax.types import MAX_HULLS, HullBank

_COLUMNS = 192
"""Vertical rays per side of the object's bounding rectangle; volumes are good to about 0.2 %."""


class Measures(NamedTuple):
    """Measures of a solid of density 1 kg/m^3, in the frame of its planes.

    Attributes:
        volume: m^3.
        com: [3] m.
        inertia: [3, 3] about the centre of mass, m^5 (times density: kg m^2).
        min_width: m, smallest caliper width of the vertical projection.
    """

    volume: float
    com: np.ndarray
    inertia: np.ndarray
    min_width: float


def measure(vertices: np.ndarray, planes: np.ndarray) -> Measures:
    """Measure the union of M <= `MAX_HULLS` hulls: vertices [M, V, 3] m and planes [M, F, 4]."""
    outline = _outline(vertices)
    points, cell = _raster(outline)
    x, y = points.T.astype(np.float32)
    # A repeated hull changes no union, and one shape means one compilation.
    padded = planes[np.minimum(np.arange(MAX_HULLS), len(planes) - 1)]
    bottom, top = (np.asarray(z, np.float64) for z in _intervals(padded, x, y))
    length, first, second = _union_moments(bottom, top)
    inside = length > 0
    volume, com, inertia = _mass_properties(points[inside], length[inside], first[inside], second[inside], cell)
    return Measures(volume, com, inertia, min_width(outline))


def projection(bank: HullBank, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Return an object's vertical projection, m: points [K, 2] of cells of equal area, and its outline [P, 2]."""
    ids = np.asarray(bank.object_hulls[index])
    vertices = np.asarray(bank.full.vertices)[ids[ids >= 0]]
    outline = _outline(vertices)
    points, _ = _raster(outline)
    inside = np.zeros(len(points), bool)
    for hull in vertices:
        left = np.flatnonzero(~inside)
        for side in ConvexHull(hull[:, :2].astype(np.float64)).equations:
            left = left[points[left] @ side[:2] + side[2] <= 0]
        inside[left] = True
    return points[inside], outline


def _outline(vertices: np.ndarray) -> np.ndarray:
    """Return the convex outline [P, 2] m of hulls [M, V, 3] seen from above."""
    xy = vertices[..., :2].reshape(-1, 2).astype(np.float64)
    return xy[ConvexHull(xy).vertices]


def _raster(outline: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the centres [K, 2] m of the cells of the bounding rectangle, and the size [2] m of a cell."""
    lower, upper = outline.min(axis=0), outline.max(axis=0)
    cell = (upper - lower) / _COLUMNS
    axes = [lower[i] + cell[i] * (np.arange(_COLUMNS) + 0.5) for i in range(2)]
    return np.column_stack([grid.ravel() for grid in np.meshgrid(*axes)]), cell


def min_width(outline: np.ndarray) -> float:
    """Return the smallest caliper width of a convex polygon [K, 2]; it is attained along an edge normal."""
    edges = np.roll(outline, -1, axis=0) - outline
    normals = np.column_stack([-edges[:, 1], edges[:, 0]]) / np.linalg.norm(edges, axis=1, keepdims=True)
    return float(np.ptp(outline @ normals.T, axis=0).min())


@jax.jit
def _intervals(planes: jax.Array, x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Cut [K] vertical rays with every hull [M, F, 4]: bottoms and tops [M, K]."""
    return jax.lax.map(partial(_interval, x=x, y=y), jnp.asarray(planes))


def _interval(planes: jax.Array, x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
    return vertical_interval(planes, x, y)


def _union_moments(bottom: np.ndarray, top: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Integrate 1, z and z^2 over the union of intervals [M, K], per ray; empty intervals have top < bottom."""
    hit = top > bottom
    bottom, top = np.where(hit, bottom, 0.0), np.where(hit, top, 0.0)
    order = bottom.argsort(axis=0)
    bottom, top = np.take_along_axis(bottom, order, 0), np.take_along_axis(top, order, 0)
    reached = np.maximum.accumulate(top, axis=0)
    start = np.maximum(bottom[1:], reached[:-1])
    bottom, top = np.concatenate([bottom[:1], start]), np.concatenate([top[:1], np.maximum(top[1:], start)])
    length, first, second = (((top**k - bottom**k) / k).sum(axis=0) for k in (1, 2, 3))
    return length, first, second


def _mass_properties(
    xy: np.ndarray, length: np.ndarray, first: np.ndarray, second: np.ndarray, cell: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray]:
    """Sum columns of cross-section `cell` [2] m into volume, centre of mass and inertia at unit density."""
    area = float(cell.prod())
    volume = area * float(length.sum())
    com = area * np.array([*(length @ xy), first.sum()]) / volume
    moments = np.zeros((3, 3))
    moments[:2, :2] = (xy.T * length) @ xy + np.diag(cell**2 / 12 * length.sum())
    moments[:2, 2] = moments[2, :2] = xy.T @ first
    moments[2, 2] = second.sum()
    covariance = area * moments - volume * np.outer(com, com)
    return volume, com, np.trace(covariance) * np.eye(3) - covariance
