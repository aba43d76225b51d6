"""Which way up a mesh is: whether another axis would stand it on a flatter base."""

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from pregrasp_jax.assets import columns

_CONTACT = 0.003
"""m; columns whose lowest point is nearer than this to the floor stand on it."""

_FLAT = 0.6
"""A base that is at least this share of the outline seen from above is flat, and an object is meant to stand on it."""

_WORSE = 0.65
"""A base whose share is below this many times that of another axis is the wrong one. An upright cup whose base is half
as wide as its rim has 0.3; a lying cylinder, 0.2 to 0.45."""


def better_axes(vertices: np.ndarray, faces: np.ndarray) -> tuple[str, ...]:
    """Return the axes that would stand a mesh on a far flatter base than z does; empty where z is right.

    Turning an object over is no better: cups stand on their smaller end.

    Args:
        vertices: [V, 3] m.
        faces: [F, 3], anticlockwise seen from outside.
    """
    shares = {axis: max(base_shares(vertices, faces, axis)) for axis in "xyz"}
    now = base_shares(vertices, faces, "z")[0]
    best = max(shares["x"], shares["y"])
    if best < _FLAT or now >= _WORSE * best:
        return ()
    return tuple(axis for axis in "xy" if shares[axis] >= _FLAT and now < _WORSE * shares[axis])


def base_shares(vertices: np.ndarray, faces: np.ndarray, axis: str) -> tuple[float, float]:
    """Return the base's share of the outline seen along an axis: standing on its lower end, and on its upper end."""
    turned = np.roll(vertices, 2 - "xyz".index(axis), axis=1)
    x, y = columns.grid(turned[:, :2].min(axis=0), turned[:, :2].max(axis=0))
    solid = columns.cut(turned, faces, x, y)
    cells = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    outline = _area(cells[np.isfinite(solid.bottom)])
    if not outline:
        return 0.0, 0.0
    low, high = solid.bottom < solid.bottom.min() + _CONTACT, solid.top > solid.top.max() - _CONTACT
    return _area(cells[low]) / outline, _area(cells[high]) / outline


def _area(points: np.ndarray) -> float:
    """Return the area of the convex outline of points [K, 2]; a base may be a ring."""
    try:
        return float(ConvexHull(points).volume) if len(points) > 2 else 0.0
    except QhullError:
        return 0.0


def doubt(vertices: np.ndarray, faces: np.ndarray, suffix: str, said: str | None) -> str:
    """Return one line on why z may not be up, where nobody has said that it is; empty if nothing speaks against it.

    Args:
        vertices: [V, 3] m.
        faces: [F, 3], anticlockwise seen from outside.
        suffix: format of the file.
        said: the axis that is up by the format.
    """
    remedy = "in objects.yaml; up: z says that it is right"
    now = base_shares(vertices, faces, "z")[0]
    if better := better_axes(vertices, faces):
        share = max(base_shares(vertices, faces, better[0]))
        axes = " or ".join(f"{axis}, -{axis}" for axis in better)
        return (
            f"may lie on its side: the base covers {now:.0%} of the outline, {share:.0%} with up: {axes}; "
            f"set it {remedy}"
        )
    if said in ("x", "y") and max(base_shares(vertices, faces, said)) >= _WORSE * now:
        return f"z is taken to be up, by its {suffix} format it is {said}; set up: {said} {remedy}"
    return ""
