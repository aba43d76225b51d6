"""A Q-network for CPUs: it sees only what surrounds the hand, and computes on 2 cm patches.

The half ring reaches 0.2 m, so a window around the hand holds all that a push can touch, on two thirds of the cells.
Inside it a patch of 4x4 cells is one position with all of its 16 pixels as channels, and five residual blocks look
0.22 m in every direction. At 32 channels an update costs a fifth of the paper's network at width 0.25.

Values between the middles of patches are interpolated, so that by themselves they know nothing narrower than 2 cm, and
what lies on the way of a push has to reach its end through the blocks. A second readout, of path channels, looks at
five points along the straight way from the hand to every cell and past it, and makes a value of what it finds there.

Because the window moves with the hand, the network also knows where the hand is while it is still outside the picture.
It is told where every patch lies, in the window and on the table: the edges over which things fall are seldom in view.
"""

import math
from typing import Any, NamedTuple

import flax.linen as nn
import flax.struct as struct
import jax
import jax.numpy as jnp
import numpy as np

from pregrasp_jax.config import TaskConfig
from pregrasp_jax.heightmap import SEGMENTATION, network_input
from pregrasp_jax.learning.networks import (
    PATH,
    PATH_READOUT,
    READOUT,
    Conv,
    interpolation_weights,
    upsample,
    upsample_positions,
)
from pregrasp_jax.spaces import grid
from pregrasp_jax.types import HandPose, Observation

PATCH = 4
"""Cells per side of what the network takes for one position."""

DOUBLINGS = int(math.log2(PATCH))
"""Times that a map of patches is doubled to become one of cells."""

LOOKS = (0.25, 0.5, 0.75, 1.0, 1.3)
"""Where the second readout looks, as shares of the way from the hand to the end of a push."""

_BEHIND, _BESIDE, _BEYOND = 16, 4, 24
"""Cells of the window behind the hand, and beyond the reach of a push at its sides and ahead of it, where a row of
objects may be pushed off the table."""


class WindowSize(NamedTuple):
    """How far a window reaches from the hand, in cells.

    Attributes:
        beside: to either side (rows).
        behind: cols with smaller x.
        ahead: cols with larger x.
        reach: of the longest push, to either side and ahead.
        back: of the longest push, backwards.
    """

    beside: int
    behind: int
    ahead: int
    reach: int
    back: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows, as many on either side of the hand, and columns."""
        return 2 * self.beside + 1, self.behind + self.ahead

    @property
    def reached(self) -> tuple[slice, slice]:
        """Rows and columns of the smallest box that holds all ends of pushes."""
        rows = slice(self.beside - self.reach, self.beside + self.reach + 1)
        return rows, slice(self.behind - self.back, self.behind + self.reach + 1)


class Window(struct.PyTreeNode):
    """What surrounds the hand.

    Attributes:
        images: [..., R, C, 3] float32, the hand in the middle row: the two images of `heightmap.network_input`, and 1
            inside the workspace; all are 0 outside of it.
        origin: [..., 2] int32, row and col of the grid where the window begins; may lie outside.
    """

    images: jax.Array
    origin: jax.Array


def window_size(task: TaskConfig) -> WindowSize:
    """Return the window that holds every push of a task, whose (half) ring has the radius `r_out`."""
    reach = math.ceil(task.r_out / grid.HEIGHTMAP_RESOLUTION)

    def padded(cells: int) -> int:
        return PATCH * math.ceil(cells / PATCH)

    beside = padded(reach + _BESIDE)
    behind, back = (beside, reach) if task.full_ring else (_BEHIND, 0)
    return WindowSize(beside=beside, behind=behind, ahead=padded(reach + _BEYOND), reach=reach, back=back)


def look_around_hand(obs: Observation, target_slot: jax.Array, *, size: WindowSize) -> Window:
    """Cut the window around the hand out of an observation (unbatched).

    Args:
        obs: the observation.
        target_slot: () int32.
        size: of the window.
    """
    images = network_input(obs, target_slot)
    images = jnp.concatenate([images, jnp.ones_like(images[..., :1])], axis=-1)
    origin = _window_origin(obs.hand, size)
    rows, cols = size.shape
    padded = jnp.pad(images, ((rows, rows), (cols, cols), (0, 0)))
    start = (origin[0] + rows, origin[1] + cols, jnp.int32(0))
    return Window(jax.lax.dynamic_slice(padded, start, (rows, cols, 3)), origin)


def cells_around_hand(hand: HandPose, *, size: WindowSize) -> jax.Array:
    """Return the cells [H, W] bool that the network values, mirrored or not, for a pose of the hand."""
    rows, cols = size.shape
    inner = jnp.ones((rows - 2, cols, 1), bool)  # the last row has no value, nor has that of the mirror image
    return paste(inner, _window_origin(hand, size) + jnp.array([1, 0]))[..., 0]


def _window_origin(hand: HandPose, size: WindowSize) -> jax.Array:
    """Return row and col [2] int32 of the grid where the window begins."""
    # Positions of the hand are cell centres, and the start lies on a corner of cells.
    row, col = grid.world_to_cell(hand.xy + 0.01 * grid.HEIGHTMAP_RESOLUTION)
    return jnp.stack([row - size.beside, col - size.behind])


def mirror_window(window: Window) -> Window:
    """Reflect the windows of B scenes in the robot's plane y = 0."""
    rows = window.images.shape[1]
    row, col = window.origin[:, 0], window.origin[:, 1]
    return Window(window.images[:, ::-1], jnp.stack([grid.GRID_SIZE - rows - row, col], axis=-1))


def paste(q: jax.Array, origin: jax.Array) -> jax.Array:
    """Put the values of a window [R, C, K] at `origin` [2] into the grid: [H, W, K], 0 outside of the window."""
    rows, cols, depth = q.shape
    blank = jnp.zeros((grid.GRID_SIZE + 2 * rows, grid.GRID_SIZE + 2 * cols, depth), q.dtype)
    pasted = jax.lax.dynamic_update_slice(blank, q, (origin[0] + rows, origin[1] + cols, jnp.int32(0)))
    return pasted[rows:-rows, cols:-cols]


class CompactNetwork(nn.Module):
    """Q-values of the pushes inside a window around the hand.

    Attributes:
        size: of the window, where the hand is in it and what is within its reach.
        num_choices: K, values per cell.
        channels: of every layer.
        blocks: residual blocks.
        path_channels: F, channels that are read along the way of every push before they become its value; 0 for none.
        initial_bias: Q-value of every push before training.
    """

    size: WindowSize
    num_choices: int = 2
    channels: int = 32
    blocks: int = 5
    path_channels: int = 0
    initial_bias: float = 0.0

    @nn.compact
    def __call__(self, window: Window) -> jax.Array:
        """Evaluate the whole grid.

        Args:
            window: of B scenes.

        Returns:
            [B, H, W, K] float32; 0 for pushes that end outside the window.
        """
        x = self._features(window)
        q = self._interpolated(x)
        if self.path_channels:
            rows, cols = way_weights(self.size)
            q = q.at[:, *self.size.reached].add(self._along(x, rows[None], cols[None]))
        return jax.vmap(paste)(q, window.origin)

    @nn.compact
    def q_at(self, window: Window, row: jax.Array, col: jax.Array) -> jax.Array:
        """Return ``self(window)[b, row[b], col[b]]``, [B, K], for rows and cols [B] int32 of the grid."""
        x = self._features(window)
        q = self._interpolated(x)
        row, col = row - window.origin[:, 0], col - window.origin[:, 1]
        height, width = q.shape[1:3]
        inside = (row >= 0) & (row < height) & (col >= 0) & (col < width)
        row, col = jnp.clip(row, 0, height - 1), jnp.clip(col, 0, width - 1)
        taken = q[jnp.arange(len(row)), row, col]
        if self.path_channels:
            rows, cols = map(jnp.asarray, way_weights(self.size))
            row, col = (cell - box.start for cell, box in zip((row, col), self.size.reached, strict=True))
            within = (row >= 0) & (row < len(rows)) & (col >= 0) & (col < len(cols))
            along = self._along(x, rows[row][:, None], cols[col][:, None])[:, 0, 0]
            taken += jnp.where(within[:, None], along, 0.0)
        return jnp.where(inside[:, None], taken, 0.0)

    def _features(self, window: Window) -> jax.Array:
        """Return [B, (R - 1) / 4, C / 4, C_out]: the last row completes no patch, it is there for the mirror image."""
        window = window.replace(images=window.images[:, :-1])
        x = window.images
        assert x.ndim == 4 and x.shape[-1] == 3, f"expected [B, R, C, 3], got {x.shape}"
        assert x.shape[1] % PATCH == 0 and x.shape[2] % PATCH == 0, f"R and C must be divisible by {PATCH}: {x.shape}"
        float32, he = jnp.dtype(jnp.float32), nn.initializers.he_normal()
        x = jnp.concatenate([patches(_label_channels(x)), coordinates(window)], axis=-1)
        x = nn.relu(Conv(self.channels, 3, he, float32, name="stem")(x))
        for i in range(self.blocks):
            hidden = nn.relu(Conv(self.channels, 3, he, float32, name=f"block{i}_in")(x))
            # Zero at first: a network of identities learns from the first update on.
            x = nn.relu(x + Conv(self.channels, 3, nn.initializers.zeros, float32, name=f"block{i}_out")(hidden))
        return x

    def _interpolated(self, x: jax.Array) -> jax.Array:
        """Return the values [B, R - 1, C, K] that patches have, between their middles interpolated."""
        small, bias = nn.initializers.variance_scaling(1e-4, "fan_in", "normal"), self.initial_bias
        float32 = jnp.dtype(jnp.float32)
        q = Conv(self.num_choices, 1, small, float32, nn.initializers.constant(bias), name=READOUT)(x)
        for _ in range(DOUBLINGS):
            q = upsample(q)
        return q

    def _along(self, x: jax.Array, rows: Any, cols: Any) -> jax.Array:
        """Return what the ways of pushes add, [B, R, S, K], that weights [B | 1, R, L, N] and [B | 1, S, L, M] read."""
        float32, looks = jnp.dtype(jnp.float32), len(LOOKS)
        # The parts of all looks are added before they become values.
        init = nn.initializers.variance_scaling(2.0 / looks, "fan_in", "normal")
        parts = Conv(looks * self.path_channels, 1, init, float32, name=PATH)(x)
        parts = parts.reshape(*x.shape[:3], looks, self.path_channels)
        rows, cols = (jnp.broadcast_to(w, (len(x), *w.shape[1:])) for w in (rows, cols))
        parts = jnp.einsum("bslm,bnmlf->blnsf", cols, parts, precision="highest")
        found = jnp.einsum("brln,blnsf->brsf", rows, parts, precision="highest")
        # Zero at first: it may join a network that has learnt without it.
        return Conv(self.num_choices, 1, nn.initializers.zeros, float32, name=PATH_READOUT)(nn.relu(found))


def way_weights(size: WindowSize) -> tuple[np.ndarray, np.ndarray]:
    """Return by which weights the ways from the hand to the cells within reach read the patches of a window.

    At each of L `LOOKS` two patches of a line are read, in the proportions in which `upsample` interpolates between
    them; ways that leave the window end at its border.

    Returns:
        [R, L, N] for R rows and N rows of patches, and [S, L, M] for S cols.
    """

    def of_line(num_cells: int, hand: int, reached: slice) -> np.ndarray:
        num_patches = num_cells // PATCH
        last = PATCH * num_patches - 1
        seen = np.clip(hand + np.array(LOOKS) * (np.arange(num_cells)[reached, None] - hand), 0, last)
        return interpolation_weights(upsample_positions(seen, num_patches, last + 1), num_patches).astype(np.float32)

    (num_rows, num_cols), (rows, cols) = size.shape, size.reached
    return of_line(num_rows, size.beside, rows), of_line(num_cols, size.behind, cols)


def patches(x: jax.Array) -> jax.Array:
    """Turn the pixels of every patch into channels: [B, R, C, K] to [B, R / 4, C / 4, 16 K]."""
    batch, rows, cols, channels = x.shape
    x = x.reshape(batch, rows // PATCH, PATCH, cols // PATCH, PATCH, channels)
    return x.transpose(0, 1, 3, 2, 4, 5).reshape(batch, rows // PATCH, cols // PATCH, PATCH**2 * channels)


def coordinates(window: Window) -> jax.Array:
    """Return where the patches of B windows lie.

    Args:
        window: of B scenes.

    Returns:
        [B, R / 4, C / 4, 8] float32: row and col of the patch's centre in the window, from -1 to 1, the same on the
        table, and the squares of these four.
    """
    batch, *size = window.images.shape[:3]
    cells = [PATCH * jnp.arange(length // PATCH) + (PATCH - 1) / 2 for length in size]
    in_window = jnp.stack(jnp.meshgrid(*cells, indexing="ij"), axis=-1)
    on_table = window.origin[:, None, None] + in_window[None]

    def scaled(cell: jax.Array, length: jax.Array) -> jax.Array:
        """Map the outer edges of `length` cells to -1 and 1."""
        return (2 * cell + 1) / length - 1

    shape = (batch, *in_window.shape)
    here = jnp.broadcast_to(scaled(in_window, jnp.array(size).reshape(1, 1, 2)), shape)
    there = scaled(on_table, jnp.full((1, 1, 1, 1), grid.GRID_SIZE))
    both = jnp.concatenate([here, there], axis=-1)
    return jnp.concatenate([both, both**2], axis=-1)


def _label_channels(images: jax.Array) -> jax.Array:
    """Give every label but the table a channel of its own: [..., 3] to [..., 5]."""
    height, segmentation, inside = jnp.split(images, 3, axis=-1)
    label = jnp.round(segmentation * max(SEGMENTATION.values()))
    labels = [(label == value).astype(images.dtype) for name, value in SEGMENTATION.items() if name != "table"]
    return jnp.concatenate([height, *labels, inside], axis=-1)
