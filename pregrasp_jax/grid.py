"""The heightmap grid: workspace limits, resolution, and cell <-> world.

Rows are y, columns are x; the centre of cell (r, c) is (-0.25 + 0.005 (c + 1/2), -0.25 + 0.005 (r + 1/2)).
An action is the flat index of Q[row, col, aperture], an int32 in [0, 20 000).
"""

import jax
import jax.numpy as jnp

WORKSPACE_HALF_SIZE = 0.25
"""m; the paper's 0.5 x 0.5 m workspace is centred on the world origin."""

GRID_SIZE = 100
"""Cells per side (Sec. III-B)."""

HEIGHTMAP_RESOLUTION = 2 * WORKSPACE_HALF_SIZE / GRID_SIZE
"""m per cell: 5 mm."""

MAX_HEIGHT = 0.30
"""m; heights are clipped to [0, MAX_HEIGHT]."""

NUM_ACTIONS = GRID_SIZE * GRID_SIZE * 2


def cell_centers() -> jax.Array:
    """Return the world coordinates [GRID_SIZE] of cell centres along one axis, m."""
    return -WORKSPACE_HALF_SIZE + HEIGHTMAP_RESOLUTION * (jnp.arange(GRID_SIZE) + 0.5)


def cell_to_world(row: jax.Array, col: jax.Array) -> jax.Array:
    """Return the centre [..., 2] (x, y) of cells, m."""
    return -WORKSPACE_HALF_SIZE + HEIGHTMAP_RESOLUTION * (jnp.stack([col, row], axis=-1) + 0.5)


def world_to_cell(xy: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return row and col [...] int32 of the cells that hold the points [..., 2]; may lie outside the grid."""
    index = jnp.floor((xy + WORKSPACE_HALF_SIZE) / HEIGHTMAP_RESOLUTION).astype(jnp.int32)
    return index[..., 1], index[..., 0]


def encode_action(row: jax.Array, col: jax.Array, aperture: jax.Array) -> jax.Array:
    """Return the flat action index of Q[row, col, aperture]."""
    return ((row * GRID_SIZE + col) * 2 + aperture).astype(jnp.int32)


def decode_action(action: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return row, col and aperture of a flat action index; inverse of `encode_action`."""
    cell, aperture = action // 2, action % 2
    return cell // GRID_SIZE, cell % GRID_SIZE, aperture


def mirror_action(action: jax.Array) -> jax.Array:
    """Return the flat index of a push reflected in the robot's plane y = 0."""
    row, col, aperture = decode_action(action)
    return encode_action(GRID_SIZE - 1 - row, col, aperture)


def quantize_height(height: jax.Array) -> jax.Array:
    """Clip heights in m to [0, MAX_HEIGHT] and store them as uint8 (steps of 1.2 mm)."""
    return jnp.round(jnp.clip(height, 0.0, MAX_HEIGHT) * (255 / MAX_HEIGHT)).astype(jnp.uint8)


def dequantize_height(height: jax.Array) -> jax.Array:
    """Return uint8 heights in m, float32."""
    return height.astype(jnp.float32) * (MAX_HEIGHT / 255)
