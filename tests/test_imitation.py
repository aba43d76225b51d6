"""PPG's networks and losses: counted, compared with formulas in numpy, and right under turns."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage, special

from pregrasp_jax.config import StrokesConfig
from pregrasp_jax.learning import stroke_network as networks
from pregrasp_jax.learning.imitation import (
    Demonstration,
    Learner,
    StrokeFunction,
    make_optimizer,
    start_loss,
    turned_at_random,
    update,
)
from pregrasp_jax.learning.stroke_network import StrokeNetwork
from pregrasp_jax.spaces.turned_grid import PAD, SIZE, turning_back
from pregrasp_jax.task.push_grasp import HEADINGS, stroke_actions

ACTIONS = stroke_actions()


def convolve(x, kernel):
    """Correlate an image [H, W, C_in] with a kernel [k, k, C_in, C_out], zeros beyond the border."""
    out = [
        sum(ndimage.correlate(x[..., i], kernel[..., i, o], mode="constant") for i in range(kernel.shape[2]))
        for o in range(kernel.shape[3])
    ]
    return np.stack(out, axis=-1)


def block_by_hand(x, p):
    def norm(x, q):
        return (x - q["mean"]) / np.sqrt(q["var"] + 1e-5) * q["scale"] + q["bias"]

    hidden = np.maximum(norm(convolve(x, p["conv1"]["kernel"]), p["norm1"]), 0)
    hidden = norm(convolve(hidden, p["conv2"]["kernel"]), p["norm2"])
    return np.maximum(hidden + convolve(x, p["shortcut"]["kernel"]), 0)


def pool_by_hand(x):
    return np.max([x[i::2, j::2] for i in (0, 1) for j in (0, 1)], axis=0)


def upsample_by_hand(x):
    size = x.shape[0]
    at = np.linspace(0, size - 1, 2 * size)
    coordinates = np.meshgrid(at, at, indexing="ij")
    return np.stack([ndimage.map_coordinates(x[..., c], coordinates, order=1) for c in range(x.shape[-1])], axis=-1)


def random_like(params, seed=0):
    rng = np.random.default_rng(seed)

    def draw(path, leaf):
        values = rng.normal(size=leaf.shape) * (0.3 if path[-1].key == "kernel" else 1.0)
        return jnp.asarray(np.abs(values) + 0.5 if path[-1].key == "var" else values, jnp.float32)

    return jax.tree_util.tree_map_with_path(draw, params)


def test_it_has_the_parameters_of_the_original():
    shapes = jax.eval_shape(StrokeNetwork().init, jax.random.key(0), jnp.zeros((1, SIZE, SIZE)))["params"]
    named = jax.tree_util.tree_leaves_with_path(shapes)
    learnt = [leaf.size for path, leaf in named if path[-1].key not in ("mean", "var")]
    assert sum(learnt) == 10_069_888


def test_it_computes_what_its_formula_says():
    network = StrokeNetwork(width=1 / 32)
    image = np.random.default_rng(1).normal(size=(16, 16)).astype(np.float32)
    params = random_like(jax.eval_shape(network.init, jax.random.key(0), jnp.zeros((1, 16, 16)))["params"])
    found = np.asarray(jax.jit(network.apply)({"params": params}, jnp.asarray(image)[None]))[0]
    p = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), params)
    x = np.maximum(convolve(image[..., None].astype(float), p["stem"]["kernel"]), 0)
    x = block_by_hand(pool_by_hand(x), p["block1"])
    x = pool_by_hand(x)
    for name in ("block2", "block3", "block4", "block5"):
        x = block_by_hand(x, p[name])
    x = block_by_hand(upsample_by_hand(x), p["block6"])
    expected = convolve(upsample_by_hand(x), p["head"]["kernel"])[..., 0]  # the last two in the order of the original
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())


def test_running_moments_follow_the_batch():
    network = StrokeNetwork(width=1 / 32)
    x = jax.random.normal(jax.random.key(1), (2, 16, 16))
    params = jax.jit(network.init)(jax.random.key(0), x)["params"]
    apply = jax.jit(functools.partial(network.apply, train=True, mutable=["moments"]))
    _, sown = apply({"params": params}, x)
    moved = networks.with_moments(params, sown["moments"])
    hidden = jax.nn.relu(jnp.asarray(networks.Convolution(2, 3).apply({"params": params["stem"]}, x[..., None])))
    stem = networks._max_pool(hidden)
    hidden = jnp.asarray(networks.Convolution(4, 3).apply({"params": params["block1"]["conv1"]}, stem))
    norm = moved["block1"]["norm1"]
    np.testing.assert_allclose(norm["mean"], 0.1 * hidden.mean(axis=(0, 1, 2)), rtol=1e-4, atol=1e-6)
    unbiased = np.asarray(hidden).reshape(-1, 4).var(axis=0, ddof=1)
    np.testing.assert_allclose(norm["var"], 0.9 + 0.1 * unbiased, rtol=1e-4)
    assert moved["stem"] is not None and (moved["stem"]["kernel"] == params["stem"]["kernel"]).all()


def test_the_loss_is_the_cross_entropy_over_the_map_that_was_turned_back():
    logits, loss = np.random.default_rng(2).normal(size=(SIZE, SIZE)).astype(np.float32), jax.jit(start_loss)
    for heading, row, col in ((0, 10, 20), (3, 50, 99), (12, 0, 0)):
        table, inside = (array[heading] for array in turning_back(HEADINGS))
        back = np.where(inside, logits.ravel()[table], 0.0).astype(np.float64)
        p = special.softmax(back)
        label = np.zeros((SIZE, SIZE))
        label[row + PAD, col + PAD] = 1
        label = label.ravel()
        expected = -(label * np.log(p) + (1 - label) * np.log(1 - p)).sum()
        found = float(loss(jnp.asarray(logits), *(jnp.int32(i) for i in (row, col, heading))))
        assert found == pytest.approx(expected, rel=1e-5)


def test_a_scene_turned_by_a_right_angle_has_its_maps_four_headings_on():
    function = StrokeFunction(StrokesConfig(width=1 / 32), ACTIONS)
    height = jax.random.uniform(jax.random.key(3), (100, 100), maxval=0.2)
    values = jax.jit(function.values)
    params = jax.jit(function.init)(jax.random.key(0))
    # A right angle from x to y: row r and column c go to row c and column -r.
    found, turned = np.asarray(values(params, height)), np.asarray(values(params, height[::-1].T))
    expected = np.roll(np.swapaxes(found[::-1], 0, 1), 4, axis=-1)
    at_45 = np.arange(HEADINGS) % 4 == 2  # there cells on the diagonal lie just between two others
    np.testing.assert_allclose(turned[..., ~at_45], expected[..., ~at_45], rtol=1e-4, atol=1e-5)
    assert np.abs(turned - expected).mean() < 0.01 * np.abs(expected).mean()
    assert np.abs(turned - np.swapaxes(found[::-1], 0, 1)).max() > 1e-3, "the headings do differ"


@pytest.fixture(scope="module")
def turn_and_look():
    look = jax.jit(lambda shown: networks.window(shown.height, shown.row, shown.col, shown.heading))
    turn = jax.jit(turned_at_random)
    return lambda key, shown: (look(shown), look(turn(key, shown)))


@pytest.mark.parametrize("seed", range(12))
def test_a_demonstration_that_is_turned_still_looks_at_the_same_thing(seed, turn_and_look):
    rng = np.random.default_rng(seed)
    height = jnp.asarray(rng.uniform(0, 0.2, (100, 100)), jnp.float32)
    row, col, heading = (jnp.int32(rng.integers(n)) for n in (100, 100, 4))
    shown = Demonstration(height, row, col, 4 * heading, jnp.float32(0.5))  # right angles, where windows are exact
    before, after = turn_and_look(jax.random.key(seed), shown)
    # Reflected, left and right of the heading change places; the start's own line stays.
    same, reflected = (np.allclose(before[1:], other[1:]) for other in (after, jnp.roll(after[::-1], 1, axis=0)))
    assert same or reflected


def test_all_quarter_turns_and_reflections_occur():
    height = jnp.zeros((100, 100)).at[10, 30].set(0.1)
    shown = Demonstration(height, jnp.int32(10), jnp.int32(30), jnp.int32(1), jnp.float32(0.5))
    found = jax.jit(jax.vmap(turned_at_random, (0, None)))(jax.random.split(jax.random.key(0), 64), shown)
    assert set(np.asarray(found.heading).tolist()) == {1, 5, 9, 13, 15, 11, 7, 3}, "+1 turned, -1 reflected and turned"
    assert (np.asarray(found.height)[np.arange(64), found.row, found.col] > 0).all()


def test_the_window_is_what_lies_ahead():
    height = np.zeros((100, 100), np.float32)
    height[60, 40:45] = 0.07  # 10 to 14 cells ahead of (60, 30) along +x; 20 behind (60, 60) along -x ...
    for (row, col, heading), columns in (((60, 30, 0), range(10, 15)), ((60, 60, 8), range(16, 21))):
        window = networks.window(jnp.asarray(height), *(jnp.int32(i) for i in (row, col, heading)))
        found = np.argwhere(np.asarray(window) > 1)
        assert found.tolist() == [[32, c] for c in columns]
    beyond = networks.window(jnp.asarray(height + 0.05), jnp.int32(50), jnp.int32(99), jnp.int32(0))
    np.testing.assert_allclose(beyond[:, 1:], -0.01 / 0.03, rtol=1e-5)  # nothing is 0 m high there
    np.testing.assert_allclose(beyond[:, 0], 0.04 / 0.03, rtol=1e-5)


@pytest.mark.slow
def test_two_networks_learn_one_stroke():
    config = StrokesConfig(width=1 / 32, learning_rate=1e-2)
    function, optimizer = StrokeFunction(config, ACTIONS), make_optimizer(config, 1000)
    rows, cols = np.indices((100, 100))
    height = 0.15 * jnp.asarray((rows - 50) ** 2 + (cols - 60) ** 2 < 64, jnp.float32)
    row, col, heading = (jnp.array([i]) for i in (50, 30, 0))
    batch = Demonstration(height[None], row, col, heading, jnp.array([0.8]))
    params = function.init(jax.random.key(0))
    learner = Learner(params, optimizer.init(params), jnp.int32(0))
    step = jax.jit(lambda learner: update(function, optimizer, learner, batch))
    learner, first = step(learner)
    for _ in range(38):
        learner, _ = step(learner)
    learner, last = step(learner)
    assert last.start < first.start - 2 and last.aperture < first.aperture / 4
    index = ACTIONS.encode(jnp.int32(50), jnp.int32(30), jnp.int32(0))
    share = networks.from_aperture(function.aperture_of(learner.params, height, index))
    assert float(share) == pytest.approx(0.8, abs=0.1)
