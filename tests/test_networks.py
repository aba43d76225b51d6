import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drawn_params import drawn_params
from fake_env import ACTIONS

from pregrasp_jax.heightmap import network_input
from pregrasp_jax.learning.networks import (
    QNetwork,
    ResidualBlock,
    interpolation_weights,
    max_pool,
    num_parameters,
    upsample,
)
from pregrasp_jax.learning.q_function import QFunction

TINY = QNetwork(width=1 / 16, initial_bias=0.7)
APPLY, Q_AT = jax.jit(TINY.apply), jax.jit(functools.partial(TINY.apply, method="q_at"))


@functools.cache
def initial_params():
    return jax.jit(TINY.init)(jax.random.key(1, impl="rbg"), jnp.zeros((1, 20, 20, 2)))


@functools.cache
def tiny_params():
    """Random weights and biases: a readout of full gain and biases that are not 0, as after training."""
    return drawn_params(TINY.init, jnp.zeros((1, 20, 20, 2)))


def conv(x, p, padding):
    """A convolution from its definition, in float64."""
    kernel, bias = np.asarray(p["kernel"], np.float64), np.asarray(p["bias"], np.float64)
    size = kernel.shape[0]
    x = np.pad(x, ((padding, padding), (padding, padding), (0, 0)))
    height, width = x.shape[0] - size + 1, x.shape[1] - size + 1
    taps = [x[i : i + height, j : j + width] @ kernel[i, j] for i in range(size) for j in range(size)]
    return np.sum(taps, axis=0) + bias


def block(x, p):
    hidden = np.maximum(conv(x, p["conv1"], 1), 0)
    return np.maximum(conv(hidden, p["conv2"], 1) + conv(x, p["shortcut"], 0), 0)


def pool(x):
    height, width, channels = x.shape
    out = np.empty((height // 2, width // 2, channels))
    for r in range(height // 2):
        for c in range(width // 2):
            window = x[max(0, 2 * r - 1) : 2 * r + 2, max(0, 2 * c - 1) : 2 * c + 2]
            out[r, c] = window.max(axis=(0, 1))
    return out


def double(x):
    """Bilinear interpolation with aligned corners, axis by axis with numpy's own."""

    def weights(size):
        where = np.linspace(0, size - 1, 2 * size)
        return np.stack([np.interp(where, np.arange(size), unit) for unit in np.eye(size)], axis=1)

    return np.einsum("rh,sw,hwc->rsc", weights(x.shape[0]), weights(x.shape[1]), x, optimize=True)


def figure_3(x, params):
    """The paper's figure, layer by layer, in the figure's order (C(1,2) after the last UP)."""
    p = params["params"]
    x = np.asarray(x, np.float64)
    x = np.concatenate([block(x[..., :1], p["height_block"]), block(x[..., 1:], p["segmentation_block"])], axis=-1)
    x = pool(np.maximum(conv(x, p["fuse"], 1), 0))
    x = pool(block(x, p["down"]))
    for index in range(4):
        x = block(x, p[f"deep_{index}"])
    return conv(double(block(double(x), p["up"])), p["readout"], 0)


@pytest.mark.parametrize(("width", "millions"), [(1.0, 7.37), (0.5, 1.84), (0.25, 0.46), (0.125, 0.12)])
def test_parameter_count(width, millions):
    shapes = jax.eval_shape(QNetwork(width=width).init, jax.random.key(0), jnp.zeros((1, 100, 100, 2)))
    assert round(num_parameters(shapes) / 1e6, 2) == millions


def test_output_agrees_with_figure_3_in_float64():
    x = jax.random.normal(jax.random.key(0), (100, 100, 2))
    expected = figure_3(x, tiny_params())
    q = APPLY(tiny_params(), x[None])[0]
    assert q.shape == (100, 100, 2) and q.dtype == jnp.float32
    assert expected.std() > 0.1
    np.testing.assert_allclose(q, expected, atol=2e-5 * np.abs(expected).max())


def scalar_and_q(q):
    return jnp.sum(q * jnp.linspace(-1.0, 2.0, q.size).reshape(q.shape)), q


def corner_heavy_cells(batch: int):
    rng = np.random.default_rng(0)
    row, col = rng.integers(0, 100, batch), rng.integers(0, 100, batch)
    row[:8], col[:8] = [0, 0, 99, 99, 49, 0, 50, 1], [0, 99, 0, 99, 99, 50, 0, 98]
    return jnp.asarray(row), jnp.asarray(col)


def test_one_pixel_equals_the_whole_grid_forward_and_backward():
    batch = 24
    x = jax.random.normal(jax.random.key(0), (batch, 100, 100, 2))
    row, col = corner_heavy_cells(batch)

    def whole(params):
        return APPLY(params, x)[jnp.arange(batch), row, col]

    def pixel(params):
        return TINY.apply(params, x, row, col, method="q_at")

    def value_and_grad(function):
        return jax.jit(jax.value_and_grad(lambda p: scalar_and_q(function(p)), has_aux=True))

    (_, q_whole), grad_whole = value_and_grad(whole)(tiny_params())
    (_, q_pixel), grad_pixel = value_and_grad(pixel)(tiny_params())
    np.testing.assert_allclose(q_pixel, q_whole, atol=1e-5 * float(jnp.abs(q_whole).max()))
    for a, b in zip(jax.tree.leaves(grad_pixel), jax.tree.leaves(grad_whole), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4 * float(jnp.abs(b).max()))


def test_receptive_field_covers_every_row_and_column():
    """All 100 rows (and the mirrored columns) of one image, so every phase of the two interpolations occurs."""
    x = jnp.broadcast_to(jax.random.normal(jax.random.key(4), (1, 100, 100, 2)), (100, 100, 100, 2))
    row = jnp.arange(100)
    q = jax.jit(lambda p, x: TINY.apply(p, x, row, row[::-1], method="q_at"))(tiny_params(), x)
    whole = APPLY(tiny_params(), x[:1])[0]
    np.testing.assert_allclose(q, whole[row, row[::-1]], atol=1e-5 * float(jnp.abs(whole).max()))


def test_taken_actions_are_flat_indices():
    x = jax.random.normal(jax.random.key(0), (1, 100, 100, 2))
    action = jnp.array([0, 1, 19_999, 2 * (37 * 100 + 81) + 1])
    whole = APPLY(tiny_params(), x).ravel()
    q = QFunction(TINY, ACTIONS, network_input)
    taken = jax.jit(q.at)(tiny_params()["params"], jnp.broadcast_to(x, (4, *x.shape[1:])), action)
    np.testing.assert_allclose(taken, whole[action], atol=1e-5 * float(jnp.abs(whole).max()))


def test_unbatched_equals_batched():
    x = jax.random.normal(jax.random.key(0), (2, 20, 12, 2))
    batched = APPLY(tiny_params(), x)
    assert batched.shape == (2, 20, 12, 2)
    np.testing.assert_allclose(APPLY(tiny_params(), x[1]), batched[1], rtol=1e-5, atol=1e-5)


def test_max_pool_agrees_with_the_window_operation_and_its_gradient():
    x = jax.random.normal(jax.random.key(0), (2, 100, 50, 3))
    x = x.at[:, :10, :10].set(-5.0)

    def window(x):
        return nn.max_pool(x, (3, 3), strides=(2, 2), padding=[(1, 1), (1, 1)])  # pyright: ignore[reportArgumentType]

    np.testing.assert_array_equal(max_pool(x), window(x))
    ours, theirs = (jax.jit(jax.grad(lambda x, f=f: jnp.sum(jnp.sin(f(x)))))(x) for f in (max_pool, window))
    # Ties may share the gradient differently: compare where there are none.
    np.testing.assert_allclose(ours[:, 12:, 12:], theirs[:, 12:, 12:], atol=1e-6)
    np.testing.assert_allclose(jnp.sum(ours), jnp.sum(theirs), rtol=1e-5)


def test_upsample_keeps_corners_and_planes():
    plane = jnp.arange(25.0)[:, None] * 3 + jnp.arange(20.0)[None]
    up = upsample(plane[None, ..., None])[0, ..., 0]
    assert up.shape == (50, 40)
    np.testing.assert_allclose(up[[0, 0, -1, -1], [0, -1, 0, -1]], [0, 19, 72, 91], atol=1e-4)
    expected = np.linspace(0, 72, 50)[:, None] + np.linspace(0, 19, 40)[None]
    np.testing.assert_allclose(up, expected, atol=1e-4)


def test_interpolation_weights_beyond_the_border_are_zero():
    weights = interpolation_weights(jnp.array([-3.0, -1.0, 0.0, 1.25, 3.0, 4.0]), 4)
    expected = [[0, 0, 0, 0], [0, 0, 0, 0], [1, 0, 0, 0], [0, 0.75, 0.25, 0], [0, 0, 0, 1], [0, 0, 0, 0]]
    np.testing.assert_allclose(weights, expected)


def test_initial_values_are_the_bias():
    x = jax.random.normal(jax.random.key(0), (1, 100, 100, 2))
    q = APPLY(initial_params(), x)
    np.testing.assert_allclose(q, 0.7, atol=0.15)
    assert float(jnp.std(q)) > 1e-4


def test_activations_keep_their_scale_without_normalisation():
    x = jax.random.normal(jax.random.key(0), (4, 40, 40, 16))
    for seed in range(6):
        layer = ResidualBlock(16, jnp.float32)
        x = jnp.asarray(layer.apply(layer.init(jax.random.key(seed), x), x))
    assert 0.1 < float(jnp.sqrt(jnp.mean(x**2))) < 10


def test_bfloat16_computes_and_returns_float32():
    x = jax.random.normal(jax.random.key(0), (1, 100, 100, 2))
    half = QNetwork(width=1 / 16, dtype=jnp.bfloat16)
    q, reference = jax.jit(half.apply)(tiny_params(), x), APPLY(tiny_params(), x)
    assert q.dtype == jnp.float32
    assert float(jnp.max(jnp.abs(q - reference))) < 0.1 * float(jnp.max(jnp.abs(reference)))
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(jax.eval_shape(half.init, jax.random.key(0), x)))


@pytest.mark.parametrize("shape", [(1, 100, 100, 3), (1, 98, 100, 2), (1, 100, 50, 2)])
def test_wrong_shapes_are_named(shape):
    with pytest.raises(AssertionError, match=r"divisible by 4|expected \[B, H, W, 2\]"):
        APPLY(tiny_params(), jnp.zeros(shape))


def test_a_value_for_each_of_any_number_of_choices():
    network, x = QNetwork(num_choices=5, width=1 / 16), jax.random.normal(jax.random.key(0), (2, 20, 20, 2))
    params = drawn_params(network.init, x)
    whole = jnp.asarray(jax.jit(network.apply)(params, x))
    row, col = jnp.array([3, 19]), jnp.array([0, 7])
    one = jnp.asarray(jax.jit(functools.partial(network.apply, method="q_at"))(params, x, row, col))
    assert whole.shape == (2, 20, 20, 5) and one.shape == (2, 5)
    assert float(jnp.ptp(one, axis=1).min()) > 1e-5
    np.testing.assert_allclose(one, whole[jnp.arange(2), row, col], atol=1e-5)
