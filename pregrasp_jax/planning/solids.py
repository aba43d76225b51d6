"""Solids that a heightmap can describe: stacks of frustums, all of one topology.

A frustum lies between two horizontal polygons whose sides have the same `NUM_SIDES` directions, so that its own sides
are planes. Every frustum has the same vertices, edges and faces in the same order. That is why one compiled model can
hold any of them: only numbers change, never the graph that MuJoCo walks along.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from pregrasp_jax.types import FULL_TOPOLOGY, MAX_HULLS, HullBank, Hulls

NUM_SIDES = 16
"""Directions of sides; a circle is met within 2 % of its radius, and a rectangle that one of them follows exactly."""

MIN_SIDE = 3e-4
"""m, shortest side of a polygon: MuJoCo's search on the graph of a hull must not meet two vertices in one place."""

_ANGLES = 2 * np.pi * np.arange(NUM_SIDES) / NUM_SIDES


class Frustums(NamedTuple):
    """Frustums [...] in the frame of an object, z up.

    Attributes:
        support: [..., 2, NUM_SIDES] m, how far bottom and top reach in the directions of `directions`.
        height: [..., 2] m, z of bottom and top.
        angle: [...] rad, by which the directions are turned.
        present: [...] bool.
    """

    support: np.ndarray
    height: np.ndarray
    angle: np.ndarray
    present: np.ndarray


def directions(angle: np.ndarray | np.floating) -> np.ndarray:
    """Return unit vectors [..., NUM_SIDES, 2] for a turn [...] rad."""
    turned = np.asarray(angle)[..., None] + _ANGLES
    return np.stack([np.cos(turned), np.sin(turned)], axis=-1)


def corners(support: np.ndarray, angle: np.ndarray | np.floating) -> np.ndarray:
    """Return the corners [..., NUM_SIDES, 2] m of polygons with tight `support`; k lies between sides k and k + 1."""
    following = np.roll(support, -1, axis=-1)
    step = 2 * np.pi / NUM_SIDES
    along = (following - support * np.cos(step)) / np.sin(step)
    normal = directions(angle)
    tangent = np.stack([-normal[..., 1], normal[..., 0]], axis=-1)
    return support[..., None] * normal + along[..., None] * tangent


def tighten(support: np.ndarray) -> np.ndarray:
    """Return the largest support [..., NUM_SIDES] below the one given that has no side shorter than `MIN_SIDE`."""
    step, sides = 2 * np.pi / NUM_SIDES, np.arange(NUM_SIDES)
    for _ in range(8 * NUM_SIDES):
        beside = support[..., sides - 1] + support[..., sides + 1 - NUM_SIDES]
        allowed = (beside - 1.01 * MIN_SIDE * np.sin(step)) / (2 * np.cos(step))
        if (support <= allowed + 1e-3 * MIN_SIDE).all():
            break
        support = np.minimum(support, allowed)
    return support


def area(support: np.ndarray) -> np.ndarray:
    """Return the area [...] m^2 of polygons with tight `support` [..., NUM_SIDES]."""
    return polygon_area(corners(support, np.zeros(support.shape[:-1])))


def polygon_area(points: np.ndarray) -> np.ndarray:
    """Return the area [...] of polygons [..., P, 2], counter-clockwise."""
    x, y = points[..., 0], points[..., 1]
    return 0.5 * np.sum(x * np.roll(y, -1, axis=-1) - y * np.roll(x, -1, axis=-1), axis=-1)


def vertices(solids: Frustums) -> np.ndarray:
    """Return the vertices [..., 2 NUM_SIDES, 3] m: those of the bottom, then those of the top."""
    flat = corners(solids.support, solids.angle[..., None])
    z = np.broadcast_to(solids.height[..., None, None], (*flat.shape[:-1], 1))
    both = np.concatenate([flat, z], axis=-1)
    return both.reshape(*both.shape[:-3], 2 * NUM_SIDES, 3)


def planes(solids: Frustums) -> np.ndarray:
    """Return the faces [..., NUM_SIDES + 2, 4], rows (n, d): the sides, the bottom, the top."""
    low, high = np.moveaxis(solids.height, -1, 0)
    below, above = solids.support[..., 0, :], solids.support[..., 1, :]
    slope = (below - above) / (high - low)[..., None]
    normal = np.concatenate([directions(solids.angle), slope[..., None]], axis=-1)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    offset = below + slope * low[..., None]
    sides = np.concatenate([normal, offset[..., None]], axis=-1) / length
    caps = np.zeros((*low.shape, 2, 4))
    caps[..., 0, 2], caps[..., 1, 2] = -1.0, 1.0
    caps[..., 0, 3], caps[..., 1, 3] = -low, high
    return np.concatenate([sides, caps], axis=-2)


def edges() -> np.ndarray:
    """Return the edges [3 NUM_SIDES, 2] of every frustum: round the bottom, round the top, upward."""
    k = np.arange(NUM_SIDES)
    following = (k + 1) % NUM_SIDES
    return np.concatenate(
        [
            np.stack(pair, axis=1)
            for pair in ((k, following), (k + NUM_SIDES, following + NUM_SIDES), (k, k + NUM_SIDES))
        ]
    )


class MassProperties(NamedTuple):
    """Of objects [N] of density 1 kg/m^3; see `types.HullBank` for the frames.

    Attributes:
        volume: [N] m^3.
        com: [N, 3] m.
        inertia: [N, 3, 3] m^5, about the centre of mass.
    """

    volume: np.ndarray
    com: np.ndarray
    inertia: np.ndarray


def mass_properties(solids: Frustums) -> MassProperties:
    """Return what objects [N] of `MAX_HULLS` frustums [N, MAX_HULLS] measure, as if these did not overlap.

    Simpson's rule over three cross-sections is exact for the volume, and good to a few percent for the inertia.
    """
    low, high = np.moveaxis(solids.height, -1, 0)
    share = np.array([0.0, 0.5, 1.0])
    support = solids.support[..., :1, :] + share[:, None] * (solids.support[..., 1:, :] - solids.support[..., :1, :])
    points = corners(support, solids.angle[..., None])
    z = low[..., None] + share * (high - low)[..., None]
    weight = np.array([1, 4, 1]) / 6 * (high - low)[..., None] * solids.present[..., None]
    section, first, second = polygon_moments(points)
    mass = weight * section
    volume = mass.sum(axis=(-2, -1))
    moment = np.concatenate([weight[..., None] * first, (mass * z)[..., None]], axis=-1).sum(axis=(-3, -2))
    com = moment / volume[..., None]
    spread = np.zeros((*volume.shape, 3, 3))
    spread[..., :2, :2] = (weight[..., None, None] * second).sum(axis=(-4, -3))
    spread[..., :2, 2] = spread[..., 2, :2] = (weight[..., None] * first * z[..., None]).sum(axis=(-3, -2))
    spread[..., 2, 2] = (mass * z**2).sum(axis=(-2, -1))
    spread -= volume[..., None, None] * com[..., :, None] * com[..., None, :]
    trace = np.trace(spread, axis1=-2, axis2=-1)
    return MassProperties(volume, com, trace[..., None, None] * np.eye(3) - spread)


def polygon_moments(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return area [...], first [..., 2] and second moments [..., 2, 2] of polygons [..., P, 2], counter-clockwise.

    Source: Green's theorem; the usual sums over edges.
    """
    following = np.roll(points, -1, axis=-2)
    cross = points[..., 0] * following[..., 1] - points[..., 1] * following[..., 0]
    total = points + following
    second = np.einsum("...p,...pi,...pj->...ij", cross, total, total)
    second += np.einsum("...p,...pi,...pj->...ij", cross, points, points)
    second += np.einsum("...p,...pi,...pj->...ij", cross, following, following)
    return cross.sum(axis=-1) / 2, np.einsum("...p,...pi->...i", cross, total) / 6, second / 24


def hull_bank(solids: Frustums, *, density: np.ndarray, friction: np.ndarray) -> HullBank:
    """Return objects [N] of frustums [N, MAX_HULLS] as a hull bank, whose arrays may be arguments of compiled programs.

    Args:
        solids: the first frustum of every object is present; centres of mass lie above the origin of the object frame.
        density: [N] kg/m^3.
        friction: [N] of their surfaces.
    """
    count = len(solids.present)
    found = mass_properties(solids)
    moments, axes = np.linalg.eigh(found.inertia * density[:, None, None])
    axes[..., 2] *= np.linalg.det(axes)[..., None]
    ids = np.arange(count * MAX_HULLS, dtype=np.int32).reshape(count, MAX_HULLS)
    points = vertices(solids).reshape(-1, 2 * NUM_SIDES, 3)
    faces = planes(solids).reshape(-1, NUM_SIDES + 2, 4)
    repeated = np.repeat(faces[:, -1:], FULL_TOPOLOGY[1] - faces.shape[1], axis=1)  # drawn beside hulls of the robot
    hulls = Hulls(
        vertices=np.float32(points),  # pyright: ignore[reportArgumentType]
        planes=np.float32(np.concatenate([faces, repeated], axis=1)),  # pyright: ignore[reportArgumentType]
        edges=np.broadcast_to(np.int32(edges()), (len(points), 3 * NUM_SIDES, 2)),  # pyright: ignore[reportArgumentType]
    )
    rows = {
        "mass": found.volume * density,
        "com": found.com,
        "inertia": moments,
        "inertia_quat": _quaternions(axes),
        "friction": friction,
        "height": np.where(solids.present, solids.height[..., 1], 0.0).max(axis=1),
        "min_width": np.zeros(count),
    }
    return HullBank(
        full=hulls,
        coarse=hulls,
        object_hulls=np.where(solids.present, ids, -1).astype(np.int32),  # pyright: ignore[reportArgumentType]
        names=tuple(f"rebuilt {i}" for i in range(count)),
        content_hash="",
        **{key: np.float32(value) for key, value in rows.items()},  # pyright: ignore[reportArgumentType]
    )


def _quaternions(matrices: np.ndarray) -> np.ndarray:
    """Return wxyz quaternions [N, 4] of rotations [N, 3, 3]."""
    return Rotation.from_matrix(matrices).as_quat(scalar_first=True)
