"""The fully convolutional Q-network of the paper's Fig. 3, evaluated on the whole grid or at one pixel.

Per input image RB(32); concatenated, C(3,64) - MP - RB(128) - MP - RB(256) - RB(512) - RB(256) - RB(128) - UP - RB(64)
- UP - C(1,K). The grid shrinks 100 -> 50 -> 25 and grows back. Two identities make it faster on a CPU without changing
the function:

* C(1,K) comes before the last UP: a 1x1 convolution commutes with an interpolation whose weights sum to 1.
* The loss looks at a single pixel, so `QNetwork.q_at` computes only that pixel's receptive field below the second MP.
"""

from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict
from jax.nn.initializers import Initializer

from pregrasp_jax.spaces.arrays import namespace

HEIGHT, SEGMENTATION = 0, 1
"""Channels of the network's input."""

READOUT = "readout"
"""Name of the layer whose outputs are the values, in every network."""

PATH, PATH_READOUT = "path", "path_readout"
"""Names of the layers of a second readout, whose outputs are added; its last one says 0 at first."""


def interpolation_weights(positions: Any, num_cells: int) -> Any:
    """Return weights [..., P, num_cells] that read a line of cells at fractional `positions` [..., P], linearly.

    An integer position selects its cell exactly; a position outside the line by one cell or more selects nothing,
    so a window that hangs over the border reads zeros there.
    """
    xp = namespace(positions)
    cells = xp.arange(num_cells, dtype=xp.float32).reshape((1,) * positions.ndim + (num_cells,))
    return xp.maximum(0.0, 1.0 - xp.abs(positions[..., None] - cells))


def upsample_positions(indices: Any, num_in: int, num_out: int) -> Any:
    """Return where output cells lie between input cells when the corner cells of both lines coincide."""
    return indices.astype(np.float32) * ((num_in - 1) / (num_out - 1))


def upsample_weights(num_cells: int, times: int) -> np.ndarray:
    """Return weights [2^times num_cells, num_cells] that do to a line of cells what `upsample` does so many times."""
    weights = np.eye(num_cells)
    for _ in range(times):
        positions = np.arange(2 * len(weights)) * ((len(weights) - 1) / (2 * len(weights) - 1))
        weights = interpolation_weights(positions, len(weights)) @ weights
    return weights.astype(np.float32)


def resample(x: jax.Array, rows: jax.Array, cols: jax.Array) -> jax.Array:
    """Read an image [B, H, W, C] through row weights [B | 1, R, H] and column weights [B | 1, S, W]: [B, R, S, C]."""
    batch = x.shape[0]
    rows = jnp.broadcast_to(rows, (batch, *rows.shape[1:])).astype(x.dtype)
    cols = jnp.broadcast_to(cols, (batch, *cols.shape[1:])).astype(x.dtype)
    # Selection by 0/1 weights must be exact, also where the default matmul precision is lower.
    x = jnp.einsum("brh,bhwc->brwc", rows, x, precision="highest")
    return jnp.einsum("bsw,brwc->brsc", cols, x, precision="highest")


def upsample(x: jax.Array) -> jax.Array:
    """Double an image [B, H, W, C] bilinearly with aligned corners."""
    height, width = x.shape[1:3]
    rows = interpolation_weights(upsample_positions(jnp.arange(2 * height), height, 2 * height), height)
    cols = interpolation_weights(upsample_positions(jnp.arange(2 * width), width, 2 * width), width)
    return resample(x, rows[None], cols[None])


def max_pool(x: jax.Array) -> jax.Array:
    """Pool an image [B, H, W, C] with even H, W by 3x3 windows of stride 2 centred on even cells.

    Elementwise maxima of the even cells and their neighbours: XLA's window operations have a backward pass that
    is fifteen times slower on a CPU.
    """
    for axis in (1, 2):
        pairs = x.reshape(*x.shape[:axis], x.shape[axis] // 2, 2, *x.shape[axis + 1 :])
        even, odd = (jax.lax.index_in_dim(pairs, i, axis + 1, keepdims=False) for i in (0, 1))
        # The cell left of the first window does not exist; its even cell stands in, which no maximum notices.
        left = jnp.concatenate(
            [jax.lax.slice_in_dim(even, 0, 1, axis=axis), jax.lax.slice_in_dim(odd, 0, -1, axis=axis)], axis
        )
        x = jnp.maximum(jnp.maximum(even, odd), left)
    return x


class Conv(nn.Module):
    """A convolution whose padding is chosen at the call: whole images are padded with zeros, windows are not.

    Attributes:
        channels: C_out.
        size: of the kernel.
        kernel_init: of the kernel [size, size, C_in, C_out].
        dtype: of the computation; parameters are float32.
        bias_init: of the bias [C_out].
    """

    channels: int
    size: int
    kernel_init: Initializer
    dtype: jnp.dtype
    bias_init: Initializer = nn.initializers.zeros

    @nn.compact
    def __call__(self, x: jax.Array, *, pad: bool = True) -> jax.Array:
        """Map [B, H, W, C_in] to [B, H, W, C_out], or without `pad` to [B, H - size + 1, W - size + 1, C_out]."""
        shape = (self.size, self.size, x.shape[-1], self.channels)
        kernel = self.param("kernel", self.kernel_init, shape).astype(self.dtype)
        bias = self.param("bias", self.bias_init, (self.channels,)).astype(self.dtype)
        # Padding by the convolution itself: a separate pad makes its backward pass slower by half on a CPU.
        padding = [(self.size // 2, self.size // 2) if pad else (0, 0)] * 2
        x = jax.lax.conv_general_dilated(
            x.astype(self.dtype), kernel, (1, 1), padding, dimension_numbers=("NHWC", "HWIO", "NHWC")
        )
        return x + bias.reshape(1, 1, 1, -1)


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions and a 1x1 shortcut, ReLU after the first and after the sum.

    Both summands start with unit gain, so that the ReLU of their sum keeps the scale of the activations
    through the network without normalisation layers.

    Attributes:
        channels: C_out.
        dtype: of the computation; parameters are float32.
    """

    channels: int
    dtype: jnp.dtype

    def setup(self):
        """Declare the three convolutions."""
        self.conv1 = Conv(self.channels, 3, nn.initializers.he_normal(), self.dtype)
        self.conv2 = Conv(self.channels, 3, nn.initializers.lecun_normal(), self.dtype)
        self.shortcut = Conv(self.channels, 1, nn.initializers.lecun_normal(), self.dtype)

    def __call__(self, x: jax.Array) -> jax.Array:
        """Map [B, H, W, C_in] to [B, H, W, C_out], zeros beyond the border."""
        hidden = nn.relu(self.conv1(x))
        return nn.relu(self.conv2(hidden) + self.shortcut(x))

    def window(self, x: jax.Array, inside: jax.Array) -> jax.Array:
        """Map windows [B, N, N, C_in] of an image to the windows [B, N - 4, N - 4, C_out] of the block's output.

        Args:
            x: windows, zero beyond the border of the image.
            inside: [B, N, N, 1], 1 where a cell of `x` lies in the image and 0 beyond the border.
        """
        inside = inside.astype(x.dtype)
        hidden = nn.relu(self.conv1(x, pad=False)) * inside[:, 1:-1, 1:-1]
        x = nn.relu(self.conv2(hidden, pad=False) + self.shortcut(x[:, 2:-2, 2:-2]))
        return x * inside[:, 2:-2, 2:-2]


class QNetwork(nn.Module):
    """Q-values of all pushes from a heightmap and a segmentation.

    Attributes:
        num_choices: K, values per cell.
        width: factor on all channel counts; 1.0 is the paper (7.37 M parameters).
        dtype: of the computation (float32 or bfloat16); parameters and Q-values are float32.
        initial_bias: Q-value of every push before training, up to a few hundredths.

    Source: Fig. 3; its C(1,1) is C(1,K), one map per choice: closed and open.
    """

    num_choices: int = 2
    width: float = 1.0
    dtype: jnp.dtype = jnp.float32
    initial_bias: float = 0.0

    def setup(self):
        """Declare the layers in the order of the figure."""

        def channels(at_full_width: int) -> int:
            return max(1, round(self.width * at_full_width))

        self.height_block = ResidualBlock(channels(32), self.dtype)
        self.segmentation_block = ResidualBlock(channels(32), self.dtype)
        self.fuse = Conv(channels(64), 3, nn.initializers.he_normal(), self.dtype)
        self.down = ResidualBlock(channels(128), self.dtype)
        self.deep = [ResidualBlock(channels(c), self.dtype) for c in (256, 512, 256, 128)]
        self.up = ResidualBlock(channels(64), self.dtype)
        self.readout = Conv(
            self.num_choices,
            1,
            nn.initializers.variance_scaling(1e-4, "fan_in", "normal"),
            self.dtype,
            nn.initializers.constant(self.initial_bias),
        )

    def __call__(self, x: jax.Array) -> jax.Array:
        """Evaluate the whole grid.

        Args:
            x: [H, W, 2] or [B, H, W, 2] float32, normalized height and segmentation / 3; H and W divisible by 4.

        Returns:
            [H, W, K] or [B, H, W, K] float32.
        """
        if x.ndim == 3:
            return self(x[None])[0]
        x = self._encode(x)
        for block in self.deep:
            x = block(x)
        return upsample(self.readout(self.up(upsample(x)))).astype(jnp.float32)

    def q_at(self, x: jax.Array, row: jax.Array, col: jax.Array) -> jax.Array:
        """Return ``self(x)[b, row[b], col[b]]`` at a fraction of its cost, forward and backward.

        Windows are the receptive field, backwards from the pixel: 2 cells of the half grid, 6 before RB(64), at
        most 5 cells of the quarter grid, and 4 more for each of the four blocks before. Windows may hang over the
        border; masks keep them zero there, as padding does in `__call__`.

        Args:
            x: [B, H, W, 2] float32.
            row: [B] int32.
            col: [B] int32.

        Returns:
            [B, K] float32.
        """
        height, width = x.shape[1:3]
        rows, cols = _receptive_field(row, height), _receptive_field(col, width)
        x = self._encode(x)
        x = resample(x, *(interpolation_weights(f.deep.astype(jnp.float32), f.quarter) for f in (rows, cols)))
        inside = _inside(rows.deep, rows.quarter, cols.deep, cols.quarter)
        for block in self.deep:
            x = block.window(x, inside)
            inside = inside[:, 2:-2, 2:-2]
        x = resample(x, rows.upsample, cols.upsample)
        inside = _inside(rows.up, rows.half, cols.up, cols.half)
        x = self.readout(self.up.window(x * inside.astype(x.dtype), inside))
        return resample(x, rows.pixel, cols.pixel)[:, 0, 0].astype(jnp.float32)

    def _encode(self, x: jax.Array) -> jax.Array:
        """Map [B, H, W, 2] to the [B, H/4, W/4, C] features before RB(256)."""
        assert x.ndim == 4 and x.shape[-1] == 2, f"expected [B, H, W, 2], got {x.shape}"
        assert x.shape[1] % 4 == 0 and x.shape[2] % 4 == 0, f"H and W must be divisible by 4, got {x.shape}"
        x = x.astype(self.dtype)
        features = [
            self.height_block(x[..., HEIGHT : HEIGHT + 1]),
            self.segmentation_block(x[..., SEGMENTATION : SEGMENTATION + 1]),
        ]
        x = max_pool(nn.relu(self.fuse(jnp.concatenate(features, axis=-1))))
        return max_pool(self.down(x))


class _ReceptiveField(NamedTuple):
    """What one pixel depends on along one axis.

    Attributes:
        pixel: [B, 1, 2] weights of the cells after RB(64).
        up: [B, 6] cells before RB(64), on the half grid; may lie beyond the border.
        upsample: [B, 6, 5] weights of the cells after the four deep blocks.
        deep: [B, 21] cells before the deep blocks, on the quarter grid; may lie beyond the border.
        half: number of cells of the half grid.
        quarter: number of cells of the quarter grid.
    """

    pixel: jax.Array
    up: jax.Array
    upsample: jax.Array
    deep: jax.Array
    half: int
    quarter: int


def _receptive_field(index: jax.Array, size: int) -> _ReceptiveField:
    """Return the receptive field of the cells `index` [B] int32 of a line of `size` cells."""
    half, quarter = size // 2, size // 4
    position = upsample_positions(index, half, size)
    first = jnp.floor(position).astype(jnp.int32)
    pixel = interpolation_weights(position[:, None] - first[:, None].astype(jnp.float32), 2)
    up = first[:, None] + jnp.arange(-2, 4)[None]
    position = upsample_positions(up, quarter, half)
    # Six cells of the half grid span less than 2.5 of the quarter grid, hence read at most 4 or 5 cells.
    first = jnp.floor(position[:, :1]).astype(jnp.int32)
    weights = interpolation_weights(position - first.astype(jnp.float32), 5)
    deep = first + jnp.arange(-8, 13)[None]
    return _ReceptiveField(pixel, up, weights, deep, half, quarter)


def _inside(rows: jax.Array, height: int, cols: jax.Array, width: int) -> jax.Array:
    """Return [B, R, S, 1] float32, 1 where cells (rows [B, R], cols [B, S]) lie in an image of [height, width]."""
    row_inside, col_inside = (rows >= 0) & (rows < height), (cols >= 0) & (cols < width)
    return (row_inside[:, :, None] & col_inside[:, None, :])[..., None].astype(jnp.float32)


def num_parameters(params: Any) -> int:
    """Return the number of scalars in a pytree of parameters."""
    return sum(leaf.size for leaf in jax.tree.leaves(params))


def same_shapes(params: Any, expected: Any) -> bool:
    """Return whether two pytrees of arrays, or of their shapes, have the same structure, shapes and dtypes."""
    shapes = (jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), tree) for tree in (params, expected))
    return next(shapes) == next(shapes)


def with_path_readout(params: Any, fresh: Any) -> Any:
    """Return parameters with the second readout of fresh ones, which says 0, if they lack that and nothing else.

    Args:
        params: of a network or of several.
        fresh: what the network begins with, arrays or their shapes.
    """
    known, wanted = flatten_dict(params), flatten_dict(fresh)
    missing = {path: leaf for path, leaf in wanted.items() if path not in known}
    if any(path[-2] not in (PATH, PATH_READOUT) for path in missing):
        return params
    return unflatten_dict({**missing, **known})
