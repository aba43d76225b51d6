"""From the cells of one object to a stack of frustums.

A cell belongs to an object if its centre does. So every side of the outline lies between the outermost centre of the
object and the nearest centre in front of that side that is seen to be none of it, and halfway is the best guess: on
built-in and scanned objects a side is off by 1.2 mm (standard deviation), a quarter of a cell, and 0.2 mm too far out.
"""

import numpy as np

from pregrasp_jax.planning.solids import NUM_SIDES, Frustums, area, directions
from pregrasp_jax.spaces import grid
from pregrasp_jax.types import MAX_HULLS

_CELL = grid.HEIGHTMAP_RESOLUTION
_NUM_LEVELS = 20
"""Slices of an object, of which layers are made."""

_LAYER_COST = 0.02
"""Share of an object's volume that another layer must explain."""

_MAX_LAYERS = 4
_CONVEX = 0.92
"""A footprint that fills less of its convex outline is divided."""

_NUM_CUTS, _CUTS = 8, (0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.85, 0.9)
"""Directions and places, as shares of the cells, in which a division is tried."""

_WORTH_A_CUT = 0.95
"""Two outlines must be this much smaller than one."""

_MIN_CELLS = 3
"""Fewer cells have no outline."""

_MIN_HEIGHT = 0.01
"""m; what is seen lower than this is taken to be as high."""

_TURNS = np.linspace(0, 2 * np.pi / NUM_SIDES, 9)[:-1]
_PASSES = 4
"""Sides hide cells from each other: they are moved outward together, a few times."""


def stack(xy: np.ndarray, height: np.ndarray, others: np.ndarray, *, edge: float = 0.0) -> Frustums:
    """Return the frustums [MAX_HULLS] of an object in the world.

    Args:
        xy: [N, 2] m, centres of its cells, at least one.
        height: [N] m above the table.
        others: [M, 2] m, centres of cells around it that are seen to be none of it.
        edge: m by which the camera sees objects too large on all sides.
    """
    parts = _split(xy, np.maximum(height, _MIN_HEIGHT))
    budget = max(1, MAX_HULLS // len(parts))
    found = [layer for part in parts for layer in _layers(*part, others, edge, min(budget, _MAX_LAYERS))][:MAX_HULLS]
    absent = MAX_HULLS - len(found)
    found += found[-1:] * absent
    support, heights, angle = (np.stack(column) for column in zip(*found, strict=True))
    return Frustums(support, heights, angle, np.arange(MAX_HULLS) < MAX_HULLS - absent)


def outline(xy: np.ndarray, others: np.ndarray, angle: float) -> np.ndarray:
    """Return the support [NUM_SIDES] m of the convex outline around cells [N, 2], halfway to `others` [M, 2].

    Where nothing is known of what is in front of a side, it lies half a cell beyond the outermost centre.
    """
    normal = directions(np.asarray(angle)).T
    inner, reach = (xy @ normal).max(axis=0), others @ normal
    support = inner
    for _ in range(_PASSES):
        beyond = reach > support + 1e-9
        in_front = beyond & (beyond.sum(axis=1) == 1)[:, None]
        outer = np.where(in_front, reach, np.inf).min(axis=0, initial=np.inf)
        support = (inner + np.minimum(outer, inner + _CELL)) / 2
    return support


def turn_of(xy: np.ndarray) -> float:
    """Return the turn, rad, of the directions for which the outline of cells [N, 2] is smallest: along its sides."""
    support = (directions(_TURNS) @ xy.T).max(axis=-1) + _CELL / 2
    return float(_TURNS[np.argmin(area(support))])


def _layers(
    xy: np.ndarray, height: np.ndarray, others: np.ndarray, edge: float, most: int
) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """Return (support [2, NUM_SIDES], z [2], angle) of the layers of a part, from the table up."""
    top = float(height.max())
    levels = np.linspace(0.0, top, _NUM_LEVELS + 1)
    middles = (levels[1:] + levels[:-1]) / 2
    counts = (height[None] >= middles[:, None]).sum(axis=1)
    usable = max(int((counts >= _MIN_CELLS).sum()), 1)
    angle = turn_of(xy)
    layers = []
    for first, last in _pieces(counts[:usable].astype(float), most):
        pair = []
        for level in (first, last):
            high = height >= middles[level]
            high = high if high.any() else ~high
            pair.append(outline(xy[high], np.concatenate([xy[~high], others]), angle) - edge)
        end = levels[last + 1] if last + 1 < usable else top
        # No higher layer is wider, in whatever direction: what is above a cell stands on it.
        layers.append((np.stack([pair[0], np.minimum(pair[0], pair[1])]), np.array([levels[first], end]), angle))
    return layers


def _pieces(values: np.ndarray, most: int) -> list[tuple[int, int]]:
    """Cut values [L] into at most `most` runs (first, last) that straight lines fit best, by dynamic programming."""
    count = len(values)
    cost = _misfit(values) / values.sum() + _LAYER_COST
    best, starts = [cost[0]], []
    for _ in range(1, min(most, count)):
        through = best[-1][:-1, None] + cost[1:]  # [i, last]: the last run starts after i
        starts.append(np.argmin(through, axis=0) + 1)
        best.append(through.min(axis=0))
    runs, last = [], count - 1
    for used in reversed(range(1 + int(np.argmin([row[-1] for row in best])))):
        first = int(starts[used - 1][last]) if used else 0
        runs.append((first, last))
        last = first - 1
    return runs[::-1]


def _misfit(values: np.ndarray) -> np.ndarray:
    """Return how far values [L] are from a line through the ends of every run, [first, last]; inf if last < first."""
    index = np.arange(len(values))
    first, last, at = index[:, None, None], index[None, :, None], index[None, None, :]
    share = (at - first) / np.maximum(last - first, 1)
    line = values[first] + share * (values[last] - values[first])
    off = np.where((at >= first) & (at <= last), np.abs(values[at] - line), 0.0).sum(axis=-1)
    return np.where(last[..., 0] >= first[..., 0], off, np.inf)


def _split(xy: np.ndarray, height: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Divide the cells of an object into at most three parts that are nearly convex."""
    waiting, parts = [(xy, height)], []
    while waiting:
        part = waiting.pop()
        left = _cut(part[0]) if len(parts) + len(waiting) < 2 else None
        if left is None:
            parts.append(part)
        else:
            waiting += [tuple(column[side] for column in part) for side in (left, ~left)]
    return parts


def _cut(xy: np.ndarray) -> np.ndarray | None:
    """Return on which side [N] bool of the best straight cut cells are; None where one convex outline is enough."""
    reach = xy @ directions(np.asarray(turn_of(xy))).T
    # Grown by what cells hide on average.
    whole = float(area(reach.max(axis=0) + 0.4 * _CELL))
    if len(xy) < 4 * _MIN_CELLS or len(xy) * _CELL**2 > _CONVEX * whole:
        return None
    angles = np.arange(_NUM_CUTS) * np.pi / _NUM_CUTS
    along = np.stack([np.cos(angles), np.sin(angles)], axis=1) @ xy.T
    left = (along[:, None] < np.quantile(along, _CUTS, axis=1).T[..., None]).reshape(-1, len(xy))
    sides = np.stack([left, ~left])
    supports = np.where(sides[..., None], reach, -np.inf).max(axis=2)
    enough = (sides.sum(axis=2) >= _MIN_CELLS + 1).all(axis=0)
    total = np.full(len(left), np.inf)
    total[enough] = area(supports[:, enough] + 0.4 * _CELL).sum(axis=0)
    best = int(np.argmin(total))
    return left[best] if total[best] < _WORTH_A_CUT * whole else None
