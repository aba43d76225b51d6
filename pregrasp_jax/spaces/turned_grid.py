"""The grid turned so that a heading points along its columns, as PPG's network wants it: index tables for numpy.

A map is padded to `SIZE` x `SIZE`, so that its inner square stays inside however it is turned. Cells are taken from the
nearest one; multiples of 90 degrees are exact.
"""

import functools

import numpy as np

from pregrasp_jax.spaces import grid

PAD = 22
"""Cells on every side: 100 sqrt(2) = 141.4, up to the next multiple of 16."""

SIZE = grid.GRID_SIZE + 2 * PAD
"""Cells per side of a padded map: 144."""


@functools.cache
def turning(headings: int) -> np.ndarray:
    """Return [K, SIZE * SIZE] int32: the flat padded cell that each cell reads once heading k points to +column.

    Beyond the border the last cell repeats itself.
    """
    rows, cols = _read_from(_angles(headings))
    return _flat(np.clip(rows, 0, SIZE - 1), np.clip(cols, 0, SIZE - 1))


@functools.cache
def turning_back(headings: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the inverse [K, SIZE * SIZE] int32 of `turning`, and bool [K, SIZE * SIZE], where it reads something."""
    rows, cols = _read_from(-_angles(headings))
    inside = (rows >= 0) & (rows < SIZE) & (cols >= 0) & (cols < SIZE)
    table = _flat(np.clip(rows, 0, SIZE - 1), np.clip(cols, 0, SIZE - 1))
    return table, inside.reshape(headings, -1)


@functools.cache
def window_offsets(headings: int, size: int) -> np.ndarray:
    """Return [K, size, size, 2] int32: rows and columns from the start of a stroke to the cells of a window before it.

    The start is in the middle of the window's first column, row `size` / 2, and the heading points along its rows.
    """
    angle = _angles(headings)[:, None, None]
    aside, ahead = np.meshgrid(np.arange(size) - size // 2, np.arange(size), indexing="ij")
    cols = np.cos(angle) * ahead - np.sin(angle) * aside
    rows = np.sin(angle) * ahead + np.cos(angle) * aside
    return _rounded(np.stack([rows, cols], axis=-1))


def _angles(headings: int) -> np.ndarray:
    return 2 * np.pi / headings * np.arange(headings)


def _read_from(angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns [K, SIZE, SIZE] that cells read when the map is turned by minus the angles [K]."""
    line = np.linspace(-1, 1, SIZE)
    y, x = np.meshgrid(line, line, indexing="ij")
    cos, sin = np.cos(angles)[:, None, None], np.sin(angles)[:, None, None]
    across = (SIZE - 1) / 2
    # The original's rows are -y: where a cell lies between two, it takes the other one of them than rows along y would.
    rows = SIZE - 1 - _rounded((1 - sin * x - cos * y) * across)
    return rows, _rounded((cos * x - sin * y + 1) * across)


def _rounded(values: np.ndarray) -> np.ndarray:
    """Round half to even; what is a half but for rounding errors counts as one."""
    return np.rint(np.round(values, 9)).astype(np.int32)


def _flat(rows: np.ndarray, cols: np.ndarray) -> np.ndarray:
    return (rows * SIZE + cols).reshape(len(rows), -1)
