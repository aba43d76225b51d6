"""From depth, masks and joints to the two maps that the policy reads.

What `heightmap.views.pinhole` does, in numpy and only where it matters: the image is cut to what sees the workspace,
and the robot is drawn into that part from its joints, wherever it is not clearly behind what the camera has measured.
"""

from typing import NamedTuple

import numpy as np

from pregrasp_jax.deploy.contract import GridEntry
from pregrasp_jax.deploy.drawing import draw_hulls, link_hulls
from pregrasp_jax.deploy.view import View
from pregrasp_jax.robot.following import Body
from pregrasp_jax.sensors import PointOfCell
from pregrasp_jax.spaces import grid

ROBOT_MARGIN = 0.03
"""m; what the camera sees nearer than the drawn robot by more than this is something above it, not the robot."""

OBJECT_MARGIN = 0.004
"""m, the same where a mask says that it is an object: twice the noise of a stereo camera 1 m away."""

_LIMIT, _LEVELS = 2.0, 2**23 - 1
"""m above which heights are clipped, and the steps in between."""


class Maps(NamedTuple):
    """What the policy reads.

    Attributes:
        height_m: [H, W] float32.
        labels: [H, W] uint8.
        seen: share of the cells in which the camera has measured something.
    """

    height_m: np.ndarray
    labels: np.ndarray
    seen: float


def project(
    depth_m: np.ndarray,
    labels: np.ndarray,
    *,
    view: View,
    body: Body,
    joint_pos: np.ndarray,
    entry: GridEntry,
    cell: PointOfCell = "max",
) -> Maps:
    """Return both maps.

    Args:
        depth_m: [rows, columns] float32, NaN where there is none.
        labels: [rows, columns] uint8 of the whole image, the robot unlabelled.
        view: of the camera that took the image.
        body: of the robot.
        joint_pos: [J] rad.
        entry: the grid of the contract.
        cell: which of the points above a cell is its height; see `heightmap.sensor`.
    """
    depth, label = view.cut(depth_m).copy(), view.cut(labels).copy()
    draw_robot(depth, label, view=view, body=body, joint_pos=joint_pos, entry=entry)
    return to_maps(depth, label, view=view, cell=cell)


def draw_robot(
    depth: np.ndarray,
    labels: np.ndarray,
    *,
    view: View,
    body: Body,
    joint_pos: np.ndarray,
    entry: GridEntry,
) -> None:
    """Draw the robot into a cut depth image and its labels, in place."""
    label, objects = entry.labels["robot"], [entry.labels[name] for name in ("target", "obstacle")]
    for drawn in draw_hulls(link_hulls(body.links, joint_pos), view):
        there = (drawn.rows, drawn.columns)
        known = np.isfinite(depth[there])
        margin = np.where(np.isin(labels[there], objects), np.float32(OBJECT_MARGIN), np.float32(ROBOT_MARGIN))
        nearer = ~known | (drawn.depth < depth[there] + margin)
        # Among robot pixels the nearest link counts; what the camera has measured of it does not.
        replace = nearer & ((labels[there] != label) | ~known | (drawn.depth < depth[there]))
        rows, columns = drawn.rows[replace], drawn.columns[replace]
        depth[rows, columns], labels[rows, columns] = drawn.depth[replace], label


def to_maps(depth: np.ndarray, labels: np.ndarray, *, view: View, cell: PointOfCell = "max") -> Maps:
    """Project a cut depth image with its labels upward to the grid; `heightmap.views.project_upward`."""
    cells = cells_of(depth, view)
    on_grid = cells < grid.GRID_SIZE**2
    index = cells[on_grid]
    height = view.rays[2][on_grid] * depth[on_grid] + np.float32(view.camera.world_from_optical[2, 3])
    # Keys as those of `heightmap.rasterizer`: of equal heights the larger label wins.
    level = np.rint(np.clip(height, 0.0, _LIMIT) * np.float32(_LEVELS / _LIMIT)).astype(np.int32)
    chosen, counted = _choose(index, level * 256 + labels[on_grid], cell)
    size = (grid.GRID_SIZE, grid.GRID_SIZE)
    heights = (chosen >> 8).astype(np.float32) * np.float32(_LIMIT / _LEVELS)
    return Maps(heights.reshape(size), (chosen & 255).astype(np.uint8).reshape(size), float((counted > 0).mean()))


def cells_of(depth: np.ndarray, view: View) -> np.ndarray:
    """Return the flat index [R, C] int32 of the cell above which each pixel lies; one past the last for none."""
    place = view.camera.world_from_optical[:3, 3].astype(np.float32)
    per_cell = np.float32(1 / grid.HEIGHTMAP_RESOLUTION)
    half = np.float32(grid.WORKSPACE_HALF_SIZE)
    col, row = ((view.rays[axis] * depth + (place[axis] + half)) * per_cell for axis in (0, 1))
    on_grid = (col >= 0) & (col < grid.GRID_SIZE) & (row >= 0) & (row < grid.GRID_SIZE)  # False for NaN
    with np.errstate(invalid="ignore"):
        index = row.astype(np.int32) * grid.GRID_SIZE + col.astype(np.int32)
    return np.where(on_grid, index, np.int32(grid.GRID_SIZE**2))


def _choose(index: np.ndarray, keys: np.ndarray, cell: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the chosen key of every cell (0 without a point), and how many points it has."""
    num_cells = grid.GRID_SIZE**2
    counted = np.bincount(index, minlength=num_cells)
    chosen = np.zeros(num_cells, np.int32)
    if cell == "max":
        np.maximum.at(chosen, index, keys)
        return chosen, counted
    order = np.argsort((index.astype(np.int64) << 32) + keys)
    first = np.concatenate([[0], np.cumsum(counted)[:-1]])
    place = counted // 2 if cell == "median" else np.maximum(counted - 2, 0)
    held = counted > 0
    chosen[held] = keys[order[(first + place)[held]]]
    return chosen, counted
