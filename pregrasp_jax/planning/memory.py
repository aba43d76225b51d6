"""What a planner sees of the objects, and what it remembers of them from earlier pictures of the episode."""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation

from pregrasp_jax.planning import outlines
from pregrasp_jax.planning.solids import Frustums, directions, mass_properties
from pregrasp_jax.spaces import grid
from pregrasp_jax.types import MAX_HULLS, MAX_OBJECTS, Observation

_HIDDEN = 0.98
"""An object beside what hides it is itself hidden if less than this share is seen of what was seen before."""

_MIN_MATCH = 0.6
"""Share of the cells that must agree, else the remembered shape is not what is seen now: it fell, perhaps."""

PINHOLE_EDGE = 2.0e-3
"""m by which a pinhole camera's heightmap shows objects too large on all sides: a cell is theirs if any point is."""

_COARSE = np.deg2rad(np.arange(-180, 180, 15))
_SHIFTS = np.stack(np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0]), axis=-1).reshape(-1, 2)


class Sight(NamedTuple):
    """All that a decision may read.

    Attributes:
        obs: what the camera sees and where the hand has been sent, host arrays.
        joint_pos: [J] rad or m, the joints of the robot.
        target: slot of the target.
        pushes: made in this episode.
    """

    obs: Observation
    joint_pos: np.ndarray
    target: int
    pushes: int = 0


class Shape(NamedTuple):
    """An object as it was seen best.

    Attributes:
        solids: [MAX_HULLS] frustums in its own frame: origin on the table below the centre of mass.
        xy: [N, 2] m, its cells in that frame.
        height: [N] m.
        pose: [3] x, y m and heading rad, where it was last.
        seen: [M] flat indices of the cells that it was last seen in.
    """

    solids: Frustums
    xy: np.ndarray
    height: np.ndarray
    pose: np.ndarray
    seen: np.ndarray


Memory = tuple[Shape | None, ...]
"""One entry per slot; None for what was never seen."""

NOTHING: Memory = (None,) * MAX_OBJECTS
"""The memory of an episode that begins."""


def look(sight: Sight, memory: Memory, *, hidden: np.ndarray, camera: np.ndarray | None) -> Memory:
    """Return what is known of every object after another picture.

    Args:
        sight: the picture.
        memory: before it.
        hidden: [H, W] bool, cells of which nothing is seen.
        camera: [3] m, where the camera is; None for one that looks straight down everywhere.
    """
    ids = np.asarray(sight.obs.instance_ids)
    height = grid.dequantize_height(np.asarray(sight.obs.height))
    edge = 0.0 if camera is None else PINHOLE_EDGE
    return tuple(_look_at(ids == slot + 1, height, hidden, shape, edge) for slot, shape in enumerate(memory))


def _look_at(
    mask: np.ndarray, height: np.ndarray, hidden: np.ndarray, shape: Shape | None, edge: float
) -> Shape | None:
    """Return what is known of one object, whose cells are `mask` [H, W] bool."""
    seen = np.flatnonzero(mask)
    if shape is not None and np.array_equal(seen, shape.seen):
        return shape
    if len(seen) == 0:
        return shape  # under the hand, where it was
    rows, cols = np.divmod(seen, grid.GRID_SIZE)
    xy, z = grid.cell_to_world(rows, cols), height[rows, cols]
    if shape is not None and len(seen) < _HIDDEN * len(shape.xy) and _touches(mask, hidden):
        pose, match = _register(shape, xy, mask, height, hidden)
        if match > _MIN_MATCH:
            return shape._replace(pose=pose, seen=seen)
    others = grid.cell_to_world(*np.nonzero(_around(mask) & ~mask & ~hidden))
    return _new_shape(xy, z, others, seen, edge)


def _new_shape(xy: np.ndarray, height: np.ndarray, others: np.ndarray, seen: np.ndarray, edge: float) -> Shape:
    """Return an object rebuilt from the cells [N, 2] m that are seen of it now, and `others` [M, 2] around it."""
    solids = outlines.stack(xy, height, others, edge=edge)
    centre = mass_properties(Frustums(*(column[None] for column in solids))).com[0, :2]
    local = moved(solids, -centre)
    return Shape(local, xy - centre, height, np.array([*centre, 0.0]), seen)


def moved(solids: Frustums, offset: np.ndarray) -> Frustums:
    """Return frustums [MAX_HULLS] moved by `offset` [2] m."""
    shift = directions(solids.angle) @ offset
    return solids._replace(support=solids.support + shift[:, None, :])


def _touches(mask: np.ndarray, hidden: np.ndarray) -> bool:
    """Return whether a cell next to one of the object is hidden, or would be beyond the picture."""
    return bool((_around(np.pad(mask, 1)) & np.pad(hidden, 1, constant_values=True)).any())


def _around(mask: np.ndarray) -> np.ndarray:
    """Return the cells [H, W] bool of an object and those next to them, across corners too."""
    return binary_dilation(mask, np.ones((3, 3)))


def _register(
    shape: Shape, xy: np.ndarray, mask: np.ndarray, height: np.ndarray, hidden: np.ndarray
) -> tuple[np.ndarray, float]:
    """Find the pose at which a remembered object looks most like what is seen of it.

    Returns:
        pose [3], and the share of cells that agree there: of those that should be seen, and of those that are.
    """
    score = _Score(shape, mask, height, hidden)
    start = np.array([*(xy.mean(axis=0)), 0.0])
    around = np.concatenate([start[None], shape.pose[None]])
    poses = np.concatenate(
        [_spread(centre, step, turns) for centre in around for step, turns in ((0.012, _COARSE), (0.005, _COARSE))]
    )
    for step, turn in ((0.005, 8.0), (0.0025, 4.0), (0.00125, 2.0)):
        best = poses[np.argmax(score(poses))]
        poses = _spread(best, step, best[2] + np.deg2rad(turn * np.array([-1.0, -0.5, 0.0, 0.5, 1.0])))
    values = score(poses)
    best = int(np.argmax(values))
    return poses[best], float(values[best])


def _spread(centre: np.ndarray, step: float, turns: np.ndarray) -> np.ndarray:
    """Return poses [P, 3] around a place [>= 2], `step` m apart, with headings `turns` rad."""
    places = centre[:2] + step * _SHIFTS
    return np.concatenate([np.repeat(places, len(turns), axis=0), np.tile(turns, len(places))[:, None]], axis=1)


class _Score:
    """How well an object at poses [P, 3] explains a picture, in [0, 1]."""

    def __init__(self, shape: Shape, mask: np.ndarray, height: np.ndarray, hidden: np.ndarray):
        self._shape = shape
        # One map to look up: 1 of the object, 0 unknown, -1 other.
        self._labels = np.where(mask, 1.0, np.where(hidden, 0.0, -1.0)).ravel()
        self._height, self._count = height.ravel(), mask.sum()

    def __call__(self, poses: np.ndarray) -> np.ndarray:
        cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        turned = np.stack([np.stack([cos, -sin], axis=-1), np.stack([sin, cos], axis=-1)], axis=-2)
        points = np.einsum("pij,nj->pni", turned, self._shape.xy) + poses[:, None, :2]
        row, col = grid.world_to_cell(points)
        inside = (np.minimum(row, col) >= 0) & (np.maximum(row, col) < grid.GRID_SIZE)
        cell = np.where(inside, row * grid.GRID_SIZE + col, 0)
        label = np.where(inside, self._labels[cell], 0.0)
        off = np.minimum(np.abs(self._height[cell] - self._shape.height) / 0.02, 1.0)
        agree = ((label > 0) * (1 - 0.5 * off)).sum(axis=1)
        known = (label != 0).sum(axis=1)
        return agree / np.maximum(np.maximum(known, self._count), 1)


def solids_of(memory: Memory) -> tuple[Frustums, np.ndarray]:
    """Return the frustums [MAX_OBJECTS, MAX_HULLS] of all objects in their own frames, and which are known."""
    known = np.array([shape is not None for shape in memory])
    blank = next(shape for shape in memory if shape is not None).solids
    rows = [(shape.solids if shape is not None else blank) for shape in memory]
    stacked = Frustums(*(np.stack(column) for column in zip(*rows, strict=True)))
    first = np.arange(MAX_HULLS) == 0
    return stacked._replace(present=np.where(known[:, None], stacked.present, first)), known
