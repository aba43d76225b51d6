"""The heightmap grid: workspace limits, resolution, cell <-> world, and the half ring around the hand.

Rows are y, columns are x; the centre of cell (r, c) is (-0.25 + 0.005 (c + 1/2), -0.25 + 0.005 (r + 1/2)).
All functions are unbatched and serve numpy and jax alike.
"""

from typing import Any

import numpy as np

from pregrasp_jax.spaces.arrays import namespace

WORKSPACE_HALF_SIZE = 0.25
"""m; the paper's 0.5 x 0.5 m workspace is centred on the world origin."""

GRID_SIZE = 100
"""Cells per side (Sec. III-B)."""

HEIGHTMAP_RESOLUTION = 2 * WORKSPACE_HALF_SIZE / GRID_SIZE
"""m per cell: 5 mm."""

MAX_HEIGHT = 0.30
"""m; heights are clipped to [0, MAX_HEIGHT]."""

_TOLERANCE = 1e-6
"""m; cells exactly on the rim or beside the hand belong to the ring in spite of rounding."""


def cell_centers(xp: Any = np) -> Any:
    """Return the world coordinates [GRID_SIZE] float32 of cell centres along one axis, m, as arrays of module `xp`."""
    return -WORKSPACE_HALF_SIZE + HEIGHTMAP_RESOLUTION * (xp.arange(GRID_SIZE, dtype=xp.float32) + 0.5)


def cell_to_world(row: Any, col: Any) -> Any:
    """Return the centre [..., 2] (x, y) of cells, m."""
    xp = namespace(row, col)
    return -WORKSPACE_HALF_SIZE + HEIGHTMAP_RESOLUTION * (xp.stack([col, row], axis=-1) + 0.5)


def world_to_cell(xy: Any) -> tuple[Any, Any]:
    """Return row and col [...] int32 of the cells that hold the points [..., 2]; may lie outside the grid."""
    xp = namespace(xy)
    index = xp.floor((xy + WORKSPACE_HALF_SIZE) / HEIGHTMAP_RESOLUTION).astype(xp.int32)
    return index[..., 1], index[..., 0]


def half_ring(xy: Any, *, r_in: float, r_out: float, yaw: Any = 0.0, full: bool = False) -> Any:
    """Return the cells [H, W] bool whose centres may end the next push (Eq. 1).

    Args:
        xy: [2] m, commanded end of the last push.
        r_in: m, inner radius, inclusive.
        r_out: m, outer radius, inclusive.
        yaw: () rad, heading of the hand, about which angles may be +-90 degrees.
        full: also allow larger angles (the paper's Full-Ring ablation).
    """
    xp = namespace(xy)
    centers = cell_centers(xp)
    dx, dy = centers[None, :] - xy[0], centers[:, None] - xy[1]
    distance = xp.hypot(dx, dy)
    ring = (distance >= r_in - _TOLERANCE) & (distance <= r_out + _TOLERANCE)
    return ring if full else ring & (xp.cos(yaw) * dx + xp.sin(yaw) * dy >= -_TOLERANCE)


def quantize_height(height: Any) -> Any:
    """Clip heights in m to [0, MAX_HEIGHT] and store them as uint8 (steps of 1.2 mm)."""
    xp = namespace(height)
    return xp.round(xp.clip(height, 0.0, MAX_HEIGHT) * (255 / MAX_HEIGHT)).astype(xp.uint8)


def dequantize_height(height: Any) -> Any:
    """Return uint8 heights in m, float32."""
    return height.astype(namespace(height).float32) * (MAX_HEIGHT / 255)
