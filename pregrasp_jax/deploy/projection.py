"""From depth, masks and joints to the two maps that the policy reads.

What `heightmap.views.pinhole` does, in numpy and only where it matters: the image is cut to what sees the workspace,
and the robot is drawn into that part from its joints, wherever it is not clearly behind what the camera has measured.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pregrasp_jax.deploy.camera import PinholeCamera
from pregrasp_jax.deploy.contract import GridEntry
from pregrasp_jax.deploy.drawing import draw_hulls, link_hulls
from pregrasp_jax.robot.following import Body
from pregrasp_jax.spaces import grid

ROBOT_MARGIN = 0.03
"""m; what the camera sees nearer than the drawn robot by more than this is something above it, not the robot."""

OBJECT_MARGIN = 0.004
"""m, the same where a mask says that it is an object: twice the noise of a stereo camera 1 m away."""

CELLS = ("max", "second", "median")
"""Which of the points above a cell is its height; see `heightmap.sensor`."""

_TOP = 0.45
"""m above the table, of the box whose view the image is cut to; higher things are clipped to 0.30 m anyway."""

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


@dataclass(frozen=True, eq=False)
class Crop:
    """The part of the image that sees the workspace.

    Attributes:
        rows: of pixels.
        columns: of pixels.
        rays: [3, R, C] float32, world directions at depth 1 m.
    """

    rows: slice
    columns: slice
    rays: np.ndarray


def make_crop(camera: PinholeCamera) -> Crop:
    """Return the part of the image that sees the workspace up to `_TOP`.

    Raises:
        ValueError: the camera does not see all of the table in the workspace.
    """
    half = grid.WORKSPACE_HALF_SIZE
    corners = np.array([(x, y, z) for x in (-half, half) for y in (-half, half) for z in (0.0, _TOP)])
    pixels, depth = camera.project(corners)
    rows, columns = camera.shape
    on_table = corners[:, 2] == 0
    inside = (depth > 0.1) & (pixels >= 0).all(axis=1) & (pixels[:, 0] <= columns - 1) & (pixels[:, 1] <= rows - 1)
    if not inside[on_table].all():
        missing = corners[on_table & ~inside][0]
        raise ValueError(
            f"the camera at {np.round(camera.world_from_optical[:3, 3], 3).tolist()} m does not see the corner "
            f"({missing[0]:g}, {missing[1]:g}) m of the workspace; allowed is a view of all of it"
        )
    used = pixels[depth > 0.1]
    low = np.maximum(np.floor(used.min(axis=0)).astype(int) - 1, 0)
    high = np.minimum(np.ceil(used.max(axis=0)).astype(int) + 2, (columns, rows))
    row_slice, column_slice = slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))
    return Crop(row_slice, column_slice, camera.rays(row_slice, column_slice))


def project(
    depth_m: np.ndarray,
    labels: np.ndarray,
    *,
    camera: PinholeCamera,
    crop: Crop,
    body: Body,
    joint_pos: np.ndarray,
    entry: GridEntry,
    cell: str = "max",
) -> Maps:
    """Return both maps.

    Args:
        depth_m: [rows, columns] float32, NaN where there is none.
        labels: [rows, columns] uint8 of the whole image, the robot unlabelled.
        camera: that took the image.
        crop: from `make_crop`.
        body: of the robot.
        joint_pos: [J] rad.
        entry: the grid of the contract.
        cell: one of `CELLS`.
    """
    depth, label = depth_m[crop.rows, crop.columns].copy(), labels[crop.rows, crop.columns].copy()
    draw_robot(depth, label, camera=camera, crop=crop, body=body, joint_pos=joint_pos, entry=entry)
    return to_maps(depth, label, camera=camera, crop=crop, cell=cell)


def draw_robot(
    depth: np.ndarray,
    labels: np.ndarray,
    *,
    camera: PinholeCamera,
    crop: Crop,
    body: Body,
    joint_pos: np.ndarray,
    entry: GridEntry,
) -> None:
    """Draw the robot into a cut depth image and its labels, in place."""
    label, objects = entry.labels["robot"], [entry.labels[name] for name in ("target", "obstacle")]
    for drawn in draw_hulls(link_hulls(body.links, joint_pos), camera=camera, crop=crop):
        there = (drawn.rows, drawn.columns)
        known = np.isfinite(depth[there])
        margin = np.where(np.isin(labels[there], objects), np.float32(OBJECT_MARGIN), np.float32(ROBOT_MARGIN))
        nearer = ~known | (drawn.depth < depth[there] + margin)
        # Among robot pixels the nearest link counts; what the camera has measured of it does not.
        replace = nearer & ((labels[there] != label) | ~known | (drawn.depth < depth[there]))
        rows, columns = drawn.rows[replace], drawn.columns[replace]
        depth[rows, columns], labels[rows, columns] = drawn.depth[replace], label


def to_maps(depth: np.ndarray, labels: np.ndarray, *, camera: PinholeCamera, crop: Crop, cell: str = "max") -> Maps:
    """Project a cut depth image with its labels upward to the grid; `heightmap.views.project_upward`."""
    cells = cells_of(depth, camera=camera, crop=crop)
    on_grid = cells < grid.GRID_SIZE**2
    index = cells[on_grid]
    height = crop.rays[2][on_grid] * depth[on_grid] + np.float32(camera.world_from_optical[2, 3])
    # Keys as those of `heightmap.rasterizer`: of equal heights the larger label wins.
    level = np.rint(np.clip(height, 0.0, _LIMIT) * np.float32(_LEVELS / _LIMIT)).astype(np.int32)
    chosen, counted = _choose(index, level * 256 + labels[on_grid], cell)
    size = (grid.GRID_SIZE, grid.GRID_SIZE)
    heights = (chosen >> 8).astype(np.float32) * np.float32(_LIMIT / _LEVELS)
    return Maps(heights.reshape(size), (chosen & 255).astype(np.uint8).reshape(size), float((counted > 0).mean()))


def cells_of(depth: np.ndarray, *, camera: PinholeCamera, crop: Crop) -> np.ndarray:
    """Return the flat index [R, C] int32 of the cell above which each pixel lies; one past the last for none."""
    place, per_cell = camera.world_from_optical[:3, 3].astype(np.float32), np.float32(1 / grid.HEIGHTMAP_RESOLUTION)
    half = np.float32(grid.WORKSPACE_HALF_SIZE)
    col, row = ((crop.rays[axis] * depth + (place[axis] + half)) * per_cell for axis in (0, 1))
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
