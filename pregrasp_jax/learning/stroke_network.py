"""PPG's networks: where and in which direction to begin a stroke, and how wide to open the hand for it.

`StrokeNetwork` reads a height map that has been turned so that one heading points along its columns, and gives a logit
to every start; maps of all headings are compared with each other. `ApertureNetwork` reads what lies ahead of a start.

Source: the PPG reference; without ImageNet the aperture network is a small one trained from scratch.
"""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from pregrasp_jax.learning.networks import upsample
from pregrasp_jax.spaces.turned_grid import PAD, SIZE, turning, turning_back, window_offsets
from pregrasp_jax.task.push_grasp import APERTURE, HEADINGS

WINDOW = 64
"""Cells per side of what the aperture network sees."""

_OFFSET, _SCALE = 0.01, 0.03
"""m; a height is normalised as (h - offset) / scale, with constants, not by what the image holds."""

_MOMENTUM, _EPSILON = 0.1, 1e-5
"""Of batch normalization: share of the newest batch in the running moments, and what is added to a variance."""


class Convolution(nn.Module):
    """A convolution [B, H, W, C_in] -> [B, H / stride, W / stride, channels] without bias, zeros beyond the border."""

    channels: int
    size: int
    stride: int = 1

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Map images."""
        shape = (self.size, self.size, x.shape[-1], self.channels)
        kernel = self.param("kernel", nn.initializers.xavier_uniform(), shape)
        padding = [(self.size // 2, self.size // 2)] * 2
        strides = (self.stride, self.stride)
        return jax.lax.conv_general_dilated(x, kernel, strides, padding, dimension_numbers=("NHWC", "HWIO", "NHWC"))


class BatchNormalization(nn.Module):
    """Normalises channels by the moments of the batch in training, by running ones otherwise.

    The running moments are parameters without gradient; `with_moments` brings them up to date.
    """

    @nn.compact
    def __call__(self, x: jax.Array, *, train: bool) -> jax.Array:
        """Map [..., C] to the same shape."""
        size = x.shape[-1:]
        scale, bias = self.param("scale", nn.initializers.ones, size), self.param("bias", nn.initializers.zeros, size)
        mean, variance = self.param("mean", nn.initializers.zeros, size), self.param("var", nn.initializers.ones, size)
        if train:
            axes = tuple(range(x.ndim - 1))
            mean, variance = jnp.mean(x, axis=axes), jnp.var(x, axis=axes)
            unbiased = variance * (x.size // x.shape[-1]) / (x.size // x.shape[-1] - 1)
            self.sow("moments", "mean", mean)
            self.sow("moments", "var", unbiased)
        factor = scale * jax.lax.rsqrt(variance + _EPSILON)
        return x * _channels(factor, x) + _channels(bias - mean * factor, x)


class Block(nn.Module):
    """Two 3x3 convolutions and a 3x3 shortcut, each of the first two normalised if asked for; ReLU after the sum."""

    channels: int
    normalized: bool

    @nn.compact
    def __call__(self, x: jax.Array, *, train: bool) -> jax.Array:
        """Map [B, H, W, C_in] to [B, H, W, channels]."""
        hidden = Convolution(self.channels, 3, name="conv1")(x)
        if self.normalized:
            hidden = BatchNormalization(name="norm1")(hidden, train=train)
        hidden = Convolution(self.channels, 3, name="conv2")(nn.relu(hidden))
        if self.normalized:
            hidden = BatchNormalization(name="norm2")(hidden, train=train)
        return nn.relu(hidden + Convolution(self.channels, 3, name="shortcut")(x))


class StrokeNetwork(nn.Module):
    """C(3,64) - MP - RB128 - MP - RB256 - RB512 - RB256 - RB128 - UP - RB64 - UP - C(1,1), 2x2 pooling, at `width` 1.

    The last convolution comes before the last UP: it is 1x1 and has no bias, so that the two commute.

    Attributes:
        width: factor on all channel counts.
        normalized: whether blocks normalise their batch.
    """

    width: float = 1.0
    normalized: bool = True

    @nn.compact
    def __call__(self, x: jax.Array, *, train: bool = False) -> jax.Array:
        """Map normalised heights [B, N, N], N a multiple of 4, to logits [B, N, N]."""

        def block(channels: int, name: str, x: jax.Array) -> jax.Array:
            return Block(self._channels(channels), self.normalized, name=name)(x, train=train)

        x = nn.relu(Convolution(self._channels(64), 3, name="stem")(x[..., None]))
        x = block(128, "block1", _max_pool(x))
        x = block(256, "block2", _max_pool(x))
        for name, channels in (("block3", 512), ("block4", 256), ("block5", 128)):
            x = block(channels, name, x)
        x = block(64, "block6", upsample(x))
        return upsample(Convolution(1, 1, name="head")(x))[..., 0]

    def _channels(self, channels: int) -> int:
        return max(1, round(channels * self.width))


class ApertureNetwork(nn.Module):
    """Four convolutions of stride 2, the mean over the window, two dense layers, a sigmoid."""

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Map normalised windows [B, WINDOW, WINDOW] to apertures [B] in [0, 1] of their range."""
        x = x[..., None]
        for index, channels in enumerate((32, 64, 128, 128)):
            x = nn.relu(Convolution(channels, 3, 2, name=f"conv{index + 1}")(x))
        x = nn.relu(nn.Dense(128, name="dense1")(jnp.mean(x, axis=(1, 2))))
        return nn.sigmoid(nn.Dense(1, name="dense2")(x)[..., 0])


def padded(height: jax.Array) -> jax.Array:
    """Return a height map [H, W] m with `PAD` cells of -0.01 m around it, normalised, [SIZE, SIZE]."""
    return normalize(jnp.pad(height, PAD, constant_values=-_OFFSET))


def normalize(height: jax.Array) -> jax.Array:
    """Return heights [...] m as networks read them."""
    return (height - _OFFSET) / _SCALE


def turn(image: jax.Array, heading: jax.Array) -> jax.Array:
    """Return an image [SIZE, SIZE] turned so that a heading () int32 points to +column."""
    return image.ravel()[jnp.asarray(turning(HEADINGS))[heading]].reshape(SIZE, SIZE)


def turn_back(image: jax.Array, heading: jax.Array) -> jax.Array:
    """Return the image [SIZE, SIZE] that `turn` turned, zeros where it has lost something."""
    table, inside = (jnp.asarray(array)[heading] for array in turning_back(HEADINGS))
    return jnp.where(inside, image.ravel()[table], 0.0).reshape(SIZE, SIZE)


def crop(image: jax.Array) -> jax.Array:
    """Return the inner square [..., H, W] of images [..., SIZE, SIZE]."""
    return image[..., PAD:-PAD, PAD:-PAD]


def window(height: jax.Array, row: jax.Array, col: jax.Array, heading: jax.Array) -> jax.Array:
    """Return what lies ahead of the start of a stroke, normalised, [WINDOW, WINDOW]; 0 m beyond the map.

    Args:
        height: [H, W] m.
        row: () int32 of the start.
        col: () int32.
        heading: () int32.
    """
    offsets = jnp.asarray(window_offsets(HEADINGS, WINDOW))[heading]
    rows, cols = row + offsets[..., 0], col + offsets[..., 1]
    size = height.shape[0]
    inside = (rows >= 0) & (rows < size) & (cols >= 0) & (cols < size)
    values = height[jnp.clip(rows, 0, size - 1), jnp.clip(cols, 0, size - 1)]
    return normalize(jnp.where(inside, values, 0.0))


def to_aperture(share: jax.Array) -> jax.Array:
    """Return apertures [...] rad of shares [...] of their range."""
    return APERTURE.low + share * (APERTURE.high - APERTURE.low)


def from_aperture(aperture: jax.Array) -> jax.Array:
    """Return shares [...] of the range of apertures [...] rad; inverse of `to_aperture`."""
    return (aperture - APERTURE.low) / (APERTURE.high - APERTURE.low)


def with_moments(params: Any, moments: Any) -> Any:
    """Return parameters whose running moments have moved toward those that `BatchNormalization` sowed."""

    def merge(params: Any, moments: Any) -> Any:
        if not isinstance(params, dict):
            (newest,) = moments
            return (1 - _MOMENTUM) * params + _MOMENTUM * newest
        return {key: merge(value, moments[key]) if key in moments else value for key, value in params.items()}

    return merge(params, moments)


def _channels(values: jax.Array, x: jax.Array) -> jax.Array:
    return values.reshape((1,) * (x.ndim - 1) + values.shape)


def _max_pool(x: jax.Array) -> jax.Array:
    """Pool an image [B, H, W, C] with even H, W by windows of 2x2."""
    batch, height, width, channels = x.shape
    return jnp.max(x.reshape(batch, height // 2, 2, width // 2, 2, channels), axis=(2, 4))
