"""Convex parts that have the size and the volume of their mesh, and by how much they miss it.

Several ways to cut a mesh are tried until one is good: the whole, its bodies, CoACD, CoACD refitted to the surface.
Simplified parts are inscribed, so they are stretched to the mesh's own extents.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import trimesh
from scipy.spatial import ConvexHull

from pregrasp_jax.assets import columns
from pregrasp_jax.assets.decompose import cut, decompose, finish, refit, volume
from pregrasp_jax.types import MAX_HULLS

EXTENT_TOLERANCE = 1e-3
"""m by which the extents of hulls may differ from the mesh's without a word."""

VOLUME_TOLERANCE = 0.05
"""Share by which the volume may differ."""

_MAX_STRETCH = 1.06
"""More than simplification can have cost: what is missing then is a part, which stretching would not bring back."""

_PRICE = 0.01
"""Difference that one more part must save: every hull costs time in every step."""

_MIN_KNOWN = 0.9
"""A mesh that is closed along fewer of its columns is too open to have a volume."""

_NEARLY_CONVEX = 1.06
"""A body whose convex hull is at most this much larger is one part."""


class Fit(NamedTuple):
    """How far hulls are from their mesh.

    Attributes:
        mesh: [3] m, extents of the mesh.
        hulls: [3] m, extents of the hulls.
        volume: volume of the hulls' union per volume of the mesh; NaN where the mesh is too open to have one.
        difference: share of the volume by which columns of the two differ in length; NaN likewise.
    """

    mesh: np.ndarray
    hulls: np.ndarray
    volume: float
    difference: float

    @property
    def off(self) -> float:
        """m, by how much the worst of the extents differs."""
        return float(np.abs(self.hulls - self.mesh).max())

    @property
    def is_good(self) -> bool:
        """Whether nothing needs to be said."""
        return self.off <= EXTENT_TOLERANCE and abs(self.volume - 1) <= VOLUME_TOLERANCE

    def remark(self) -> str:
        """Return one line on how hulls and mesh differ; empty if they hardly do."""
        if self.is_good:
            return ""
        mesh, hulls = (" x ".join(f"{extent * 1e3:.0f}" for extent in extents) for extents in (self.mesh, self.hulls))
        sizes = f"hulls {hulls} mm, mesh {mesh} mm" if self.off > EXTENT_TOLERANCE else f"size as the mesh, {mesh} mm"
        if np.isnan(self.volume):
            return f"{sizes}; the mesh is too open to have a volume"
        return f"{sizes}; volume {self.volume:.2f} x that of the mesh"

    def as_numbers(self) -> list[float]:
        """Return all numbers in a row, for a file."""
        return [*self.mesh.tolist(), *self.hulls.tolist(), self.volume, self.difference]

    @classmethod
    def from_numbers(cls, numbers: list[float]) -> "Fit":
        """Return what `as_numbers` was called on."""
        return cls(np.array(numbers[:3]), np.array(numbers[3:6]), *numbers[6:])


def fit_parts(mesh: trimesh.Trimesh) -> tuple[tuple[np.ndarray, ...], Fit]:
    """Cut a repaired mesh into convex parts that measure what it does.

    Args:
        mesh: in m, z up.

    Returns:
        Parts as `decompose` returns them, and how well they fit.

    Raises:
        ValueError: nothing of the mesh has a volume.
    """
    tried: list[tuple[tuple[np.ndarray, ...], Fit]] = []
    for raw in _candidates(mesh):
        tried.append(_fitted(mesh, finish(raw)))
        fit = tried[-1][1]
        if fit.is_good:
            return tried[-1]
        if np.isnan(fit.volume):  # of a mesh as open as this nothing is known that could choose
            return _fitted(mesh, decompose(mesh))
    return min(tried, key=lambda found: found[1].difference + _PRICE * len(found[0]))


def _fitted(mesh: trimesh.Trimesh, parts: tuple[np.ndarray, ...]) -> tuple[tuple[np.ndarray, ...], Fit]:
    """Stretch finished parts, and measure them."""
    parts = _stretched(parts, np.ptp(mesh.vertices, axis=0))
    return parts, compare(mesh, parts)


def compare(mesh: trimesh.Trimesh, parts: tuple[np.ndarray, ...]) -> Fit:
    """Measure convex parts that stand on z = 0 against their mesh, over the columns along which it is closed."""
    vertices = np.asarray(mesh.vertices, np.float64) - [0.0, 0.0, mesh.bounds[0, 2]]
    points = np.concatenate(parts)
    both = np.concatenate([vertices, points])[:, :2]
    x, y = columns.grid(both.min(axis=0), both.max(axis=0))
    solid = columns.cut(vertices, np.asarray(mesh.faces), x, y)
    union = columns.cut(*_hull_surface(parts), x, y)
    wanted, found = solid.length[solid.known], union.length[solid.known]
    total = wanted.sum()
    sizes = np.ptp(vertices, axis=0), np.ptp(points, axis=0)
    if solid.known.mean() < _MIN_KNOWN or total <= 0:
        return Fit(sizes[0], sizes[1], np.nan, np.nan)
    return Fit(sizes[0], sizes[1], float(found.sum() / total), float(np.abs(found - wanted).sum() / total))


def _candidates(mesh: trimesh.Trimesh) -> Iterator[list[np.ndarray]]:
    """Yield ways to cut a mesh, the cheapest first; whoever is content stops asking."""
    vertices = np.asarray(mesh.vertices, np.float64)
    yield [vertices]
    bodies = mesh.split(only_watertight=False)
    if 1 < len(bodies) <= MAX_HULLS and all(_is_convex(body) for body in bodies):
        yield [np.asarray(body.vertices, np.float64) for body in bodies]
    closed = mesh.is_watertight and len(bodies) == 1
    parts = cut(mesh, preprocess_mode="auto" if closed else "on")
    if closed:
        yield parts
    yield refit(parts, mesh)


def _is_convex(body: trimesh.Trimesh) -> bool:
    return body.is_watertight and volume(np.asarray(body.vertices)) <= _NEARLY_CONVEX * abs(body.volume)


def _stretched(parts: tuple[np.ndarray, ...], extents: np.ndarray) -> tuple[np.ndarray, ...]:
    """Scale parts along the axes, z from the base, so that they extend as far as the mesh."""
    points = np.concatenate(parts)
    scale = extents / np.ptp(points, axis=0)
    scale = np.where(np.maximum(scale, 1 / scale) <= _MAX_STRETCH, scale, 1.0)
    centre = (points.min(axis=0) + points.max(axis=0)) / 2 * [1.0, 1.0, 0.0]
    return tuple((part - centre) * scale + centre for part in parts)


def _hull_surface(parts: tuple[np.ndarray, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and outward faces of the hulls of several parts."""
    faces, start = [], 0
    for part in parts:
        hull = ConvexHull(part)
        a, b, c = (part[hull.simplices[:, i]] for i in range(3))
        inward = (np.cross(b - a, c - a) * hull.equations[:, :3]).sum(axis=1) < 0
        faces.append(np.where(inward[:, None], hull.simplices[:, ::-1], hull.simplices) + start)
        start += len(part)
    return np.concatenate(parts), np.concatenate(faces)
