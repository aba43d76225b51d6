"""The compact network: its window, and that values and gradients land where the grid says."""

import dataclasses
import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drawn_params import drawn_params
from fake_env import ACTIONS, hand_at

from pregrasp_jax import heightmap
from pregrasp_jax.config import NetworkConfig, TaskConfig
from pregrasp_jax.learning.compact import (
    PATCH,
    CompactNetwork,
    Window,
    coordinates,
    look_around_hand,
    paste,
    patches,
    way_weights,
    window_size,
)
from pregrasp_jax.learning.networks import num_parameters, with_path_readout
from pregrasp_jax.learning.q_function import QFunction, make_q_function
from pregrasp_jax.presets import PRESETS
from pregrasp_jax.spaces import grid
from pregrasp_jax.spaces.actions import ActionSpace, Choice
from pregrasp_jax.types import Observation

START = (-0.30, 0.0)
SIZE = window_size(TaskConfig())


def observation(p1) -> Observation:
    """Heights that differ from cell to cell, objects 1 to 3 and the robot in four quarters."""
    rows, cols = np.indices((100, 100))
    ids = np.where(rows < 50, 1, 2) + np.where(cols < 50, 0, 1)
    ids[80:, 80:] = 9
    return Observation(jnp.asarray((7 * rows + 13 * cols) % 256, jnp.uint8), jnp.asarray(ids, jnp.uint8), hand_at(p1))


def reflection(obs: Observation, p1) -> Observation:
    """Return the observation reflected by hand: rows are y, so they and the hand's y turn around."""
    height, ids = (jnp.asarray(np.asarray(leaf)[::-1]) for leaf in (obs.height, obs.instance_ids))
    return Observation(height, ids, hand_at(p1))


@pytest.mark.parametrize("p1", [START, (-0.1025, 0.0525), (0.2475, 0.2475), (-0.2475, -0.2475), (0.0025, -0.1)])
def test_window_is_the_picture_around_the_hand_and_zero_outside(p1):
    obs = observation(p1)
    window = jax.jit(functools.partial(look_around_hand, size=SIZE))(obs, jnp.int32(1))
    whole = np.asarray(heightmap.network_input(obs, jnp.int32(1)))
    # The cell that holds p1, or the one above where p1 lies on an edge between two.
    row, col = (round((p1[i] + 0.25) / 0.005 - 0.5 + 1e-3) for i in (1, 0))
    np.testing.assert_array_equal(window.origin, [row - SIZE.beside, col - SIZE.behind])
    expected = np.zeros((*SIZE.shape, 3))
    for r in range(SIZE.shape[0]):
        for c in range(SIZE.shape[1]):
            y, x = r + row - SIZE.beside, c + col - SIZE.behind
            if 0 <= y < 100 and 0 <= x < 100:
                expected[r, c] = [*whole[y, x], 1.0]
    np.testing.assert_allclose(window.images, expected, atol=1e-5)


@pytest.mark.parametrize("full_ring", [False, True])
@pytest.mark.parametrize("r_out", [0.1, 0.15, 0.2, 0.33])
def test_window_holds_every_cell_of_the_ring(r_out, full_ring):
    task = TaskConfig(r_out=r_out, full_ring=full_ring)
    size = window_size(task)
    assert size.shape[0] % PATCH == 1 and size.shape[1] % PATCH == 0
    around, put_back = jax.jit(functools.partial(look_around_hand, size=size)), jax.jit(paste)
    for p1 in (START, (0.0025, 0.0025), (0.1975, -0.2475)):
        mask = grid.half_ring(np.array(p1, np.float32), r_in=task.r_in, r_out=r_out, full=full_ring)
        inside = np.asarray(put_back(np.ones((*size.shape, 2)), around(observation(p1), jnp.int32(0)).origin))
        assert mask.any() and (inside[mask] == 1.0).all()


def test_paste_puts_cells_where_they_come_from():
    q = np.arange(8.0 * 12 * 2, dtype=np.float32).reshape(8, 12, 2)
    pasted = np.asarray(jax.jit(paste)(q, np.array([-3, 95])))
    np.testing.assert_array_equal(pasted[:5, 95:], q[3:, :5])
    assert (pasted[5:] == 0).all() and (pasted[:, :95] == 0).all()


def test_patches_hold_their_own_pixels():
    x = np.arange(2 * 8 * 12 * 3.0, dtype=np.float32).reshape(2, 8, 12, 3)
    np.testing.assert_array_equal(np.asarray(patches(jnp.asarray(x)))[1, 1, 2].reshape(4, 4, 3), x[1, 4:8, 8:12])


def make_network(path=0):
    network = CompactNetwork(SIZE, channels=4, blocks=2, path_channels=path, initial_bias=0.3)
    images = jax.random.uniform(jax.random.key(1), (3, *SIZE.shape, 3))
    window = Window(images, jnp.array([[-10, -20], [20, 60], [3, 4]]))
    params = drawn_params(network.init, window)
    return network, params, window


@pytest.mark.parametrize("path", [0, 3])
def test_value_of_an_action_is_its_pixel_of_the_grid_and_zero_outside_the_window(path):
    network, params, window = make_network(path)
    whole = np.asarray(jax.jit(network.apply)(params, window))
    assert whole.shape == (3, 100, 100, 2) and np.ptp(whole) > 0.1
    q = QFunction(network, ACTIONS, functools.partial(look_around_hand, size=SIZE))
    cells = np.stack(np.meshgrid(range(0, 100, 3), range(0, 100, 3), indexing="ij"), axis=-1).reshape(-1, 2)
    actions = np.repeat(ACTIONS.encode(cells[:, 0], cells[:, 1], np.arange(len(cells)) % 2)[:, None], 3, axis=1)
    taken = jax.jit(jax.vmap(q.at, (None, None, 0)))(params["params"], window, actions.astype(np.int32))
    expected = whole.reshape(3, -1)[:, actions[:, 0]].T
    np.testing.assert_allclose(taken, expected, rtol=1e-4, atol=1e-6)
    assert 0.1 < np.mean(expected == 0.0) < 0.9, "some are outside of their window"
    assert whole[2, 80, 3, 1] == 0.0 != whole[2, 80, 4, 1]  # the window begins at column 4


@pytest.mark.parametrize("full_ring", [False, True])
def test_ways_from_the_hand_are_read_between_the_middles_of_patches(full_ring):
    """Patches that hold their own position are read where the looks are."""
    size = window_size(TaskConfig(full_ring=full_ring))
    for weights, hand, reached in zip(way_weights(size), (size.beside, size.behind), size.reached, strict=True):
        cells, num_patches = range(reached.start, reached.stop), weights.shape[2]
        assert weights.shape == (len(cells), 5, num_patches)
        last = 4 * num_patches - 1
        corner_on_corner = np.arange(num_patches) * last / (num_patches - 1)
        for i, cell in enumerate(cells):
            seen = [min(max(hand + share * (cell - hand), 0.0), last) for share in (0.25, 0.5, 0.75, 1.0, 1.3)]
            np.testing.assert_allclose(weights[i] @ corner_on_corner, seen, atol=1e-3)
            assert np.count_nonzero(weights[i], axis=1).max() <= 2
        np.testing.assert_allclose(weights.sum(axis=2), 1.0, atol=1e-5)


class Features(CompactNetwork):
    """The same network without its readouts."""

    @nn.compact
    def __call__(self, window):
        return self._features(window)


def test_the_second_readout_adds_what_lies_on_the_way():
    """By hand, in loops: for one push, every look reads its point between four patches."""
    network, params, window = make_network(3)
    layers = params["params"]
    plain = CompactNetwork(SIZE, channels=4, blocks=2, initial_bias=0.3)
    first = {name: layer for name, layer in layers.items() if "path" not in name}
    gain = np.asarray(jax.jit(network.apply)(params, window) - jax.jit(plain.apply)({"params": first}, window))
    features = np.asarray(Features(SIZE, channels=4, blocks=2).apply(params, window))
    kernel, bias = np.asarray(layers["path"]["kernel"])[0, 0], np.asarray(layers["path"]["bias"])
    for scene, row, col in ((0, 30, 40), (2, 71, 21), (2, 12, 56)):
        height, width = features.shape[1:3]
        total = np.zeros(3)
        for look, share in enumerate((0.25, 0.5, 0.75, 1.0, 1.3)):
            r = np.clip(SIZE.beside + share * (row - SIZE.beside), 0, 4 * height - 1) * (height - 1) / (4 * height - 1)
            c = np.clip(SIZE.behind + share * (col - SIZE.behind), 0, 4 * width - 1) * (width - 1) / (4 * width - 1)
            total += bias[3 * look : 3 * look + 3]
            for i in range(height):
                for j in range(width):
                    weight = max(0.0, 1 - abs(r - i)) * max(0.0, 1 - abs(c - j))
                    total += weight * features[scene, i, j] @ kernel[:, 3 * look : 3 * look + 3]
        expected = np.maximum(total, 0) @ np.asarray(layers["path_readout"]["kernel"])[0, 0]
        expected += np.asarray(layers["path_readout"]["bias"])
        origin = np.asarray(window.origin[scene])
        found = gain[scene, row + origin[0], col + origin[1]]
        np.testing.assert_allclose(found, expected, atol=1e-4)
        assert np.abs(expected).max() > 1e-3
    rows, cols = (np.flatnonzero(np.abs(gain[0]).max(axis=(axis, 2))) for axis in (1, 0))
    origin = np.asarray(window.origin[0])
    assert rows.max() - origin[0] == SIZE.beside + 40 and cols.max() - origin[1] == SIZE.behind + 40


@pytest.mark.parametrize("full_ring", [False, True])
def test_all_pushes_are_within_the_reach_of_the_second_readout(full_ring):
    task = TaskConfig(full_ring=full_ring)
    size = window_size(task)
    rows, cols = size.reached
    for point in ((-0.0025, 0.0525), (-0.2025, -0.1975)):
        hand = hand_at(point)
        ends = np.argwhere(np.asarray(grid.half_ring(hand.xy, r_in=task.r_in, r_out=task.r_out, full=full_ring)))
        row, col = (ends - np.asarray(look_around_hand(observation(point), jnp.int32(1), size=size).origin)).T
        assert row.min() >= rows.start and row.max() < rows.stop
        assert col.min() >= cols.start and col.max() < cols.stop


def test_a_second_readout_joins_a_network_without_changing_it_and_learns():
    task, first = TaskConfig(), NetworkConfig(architecture="compact", width=1 / 16, mirror=True, members=2)
    q = make_q_function(dataclasses.replace(first, path_channels=3), task, ACTIONS)
    before = make_q_function(first, task, ACTIONS)
    params, obs = drawn_params(before.init), observation((-0.1025, 0.0525))
    joined = with_path_readout(params, jax.jit(q.init)(jax.random.key(0, impl="rbg")))
    assert q.fits(joined) and not q.fits(params) and with_path_readout(joined, q.shapes) == joined
    values = (jax.jit(f.values)(p, obs, jnp.int32(1)) for f, p in ((before, params), (q, joined)))
    np.testing.assert_array_equal(*values)
    window = jax.tree.map(lambda x: x[None], look_around_hand(obs, jnp.int32(1), size=SIZE))
    push = jnp.array([ACTIONS.encode(np.int32(60), np.int32(40), np.int32(1))])
    gradient = jax.jit(jax.grad(lambda p: q.at(p, window, push)[0]))(joined["member1"])
    assert np.abs(gradient["path_readout"]["kernel"]).max() > 0.01
    # Of another width, or of fewer networks, it is another network.
    narrow = make_q_function(dataclasses.replace(first, width=1 / 32, path_channels=3), task, ACTIONS)
    assert not narrow.fits(with_path_readout(params, narrow.shapes))
    three = make_q_function(dataclasses.replace(first, members=3, path_channels=3), task, ACTIONS)
    assert with_path_readout(params, three.shapes) is params


def test_coordinates_say_where_patches_lie_in_the_window_and_on_the_table():
    window = Window(jnp.zeros((2, 8, 12, 3)), jnp.array([[0, 0], [-4, 90]]))
    found = np.asarray(jax.jit(coordinates)(window))
    assert found.shape == (2, 2, 3, 8)
    for scene, (first_row, first_col) in enumerate(window.origin.tolist()):
        for row, col in np.ndindex(2, 3):
            # Metres of the patch's centre: the middle of its 4 x 4 cells of 5 mm, 0.25 m at the edge of the table.
            y, x = (0.005 * (4 * index + first + 2) - 0.25 for index, first in ((row, first_row), (col, first_col)))
            expected = [-0.5 + row, (col - 1) / 1.5, y / 0.25, x / 0.25]
            np.testing.assert_allclose(found[scene, row, col], [*expected, *np.square(expected)], atol=1e-6)


def test_values_move_with_the_hand_and_the_scene():
    """The same surroundings two patches further give the same values two patches further, but for the table's edge."""
    network, params, _ = make_network()
    stem = params["params"]["stem"]
    stem["kernel"] = np.array(stem["kernel"])
    stem["kernel"][:, :, -8:] = 0.0  # does not look where on the table it is
    q = jax.jit(
        lambda obs: network.apply(
            params, jax.tree.map(lambda x: x[None], look_around_hand(obs, jnp.int32(0), size=SIZE))
        )[0]
    )
    ids = np.zeros((100, 100), np.uint8)
    ids[40:52, 45:60], ids[30:36, 45:50] = 1, 2
    here = q(Observation(jnp.asarray(30 * ids), jnp.asarray(ids), hand_at((-0.0525, -0.0025))))
    ids = np.roll(ids, (5, -7), axis=(0, 1))
    there = q(Observation(jnp.asarray(30 * ids), jnp.asarray(ids), hand_at((-0.0875, 0.0225))))
    np.testing.assert_allclose(here[40:60, 45:60], np.asarray(there)[45:65, 38:53], atol=1e-5)


@pytest.mark.parametrize("architecture", ["paper", "compact"])
def test_mirrored_scene_gets_mirrored_values(architecture):
    obs = observation((-0.1025, 0.0525))
    reflected = reflection(obs, (-0.1025, -0.0525))
    config = NetworkConfig(architecture=architecture, width=1 / 16, mirror=True)
    q = make_q_function(config, TaskConfig(), ACTIONS)
    params, values = drawn_params(q.init), jax.jit(dataclasses.replace(q, mirror_fn=None).values)
    here, there = (np.asarray(values(params, o, jnp.int32(1))) for o in (obs, reflected))
    reach = np.s_[20:100, 30:70]  # 0.2 m to both sides of the hand, and ahead: what the half ring may hold
    assert np.abs(here - there[::-1])[reach].max() > 0.1  # on its own the network is not symmetric
    found = np.asarray(jax.jit(q.values)(params, obs, jnp.int32(1)))
    np.testing.assert_allclose(found[reach], ((here + there[::-1]) / 2)[reach], rtol=1e-4, atol=1e-4)


def test_augmented_pushes_are_those_of_the_scene_or_of_its_mirror_image():
    q = make_q_function(NetworkConfig(architecture="compact", width=1 / 16, mirror=True), TaskConfig(), ACTIONS)
    obs = observation((-0.1025, 0.0525))
    reflected = reflection(obs, (-0.1025, -0.0525))
    pushes = {False: (obs, 60 * 100 + 40), True: (reflected, 39 * 100 + 40)}  # y = 0.0525 and -0.0525
    look = jax.jit(q.input_fn)
    inputs = jax.tree.map(lambda leaf: np.stack([leaf] * 64), look(obs, jnp.int32(1)))
    windows, actions = jax.device_get(
        jax.jit(q.augment)(jax.random.key(0), inputs, jnp.full(64, 2 * pushes[False][1] + 1))
    )
    seen = set()
    for i, action in enumerate(actions.tolist()):
        mirrored = action // 2 != pushes[False][1]
        expected, cell = pushes[mirrored]
        assert action == 2 * cell + 1
        window = look(expected, jnp.int32(1))
        np.testing.assert_allclose(windows.images[i], window.images, atol=1e-6)
        np.testing.assert_array_equal(windows.origin[i], window.origin)
        seen.add(mirrored)
    assert seen == {False, True}


@pytest.mark.parametrize("hand", [START, (-0.1025, 0.0525), (0.2475, -0.2475)])
@pytest.mark.parametrize("full_ring", [False, True])
def test_unguided_exploration_stays_where_the_network_has_values_on_both_sides(hand, full_ring):
    """A push without a value would never be learned, and be sampled for ever for its error."""
    config = NetworkConfig(architecture="compact", width=1 / 32, initial_bias=0.2, mirror=True)
    q = make_q_function(config, TaskConfig(full_ring=full_ring), ACTIONS)
    obs, params = observation(hand), drawn_params(q.init)
    inputs = jax.tree.map(lambda leaf: np.asarray(leaf)[None], jax.jit(q.input_fn)(obs, jnp.int32(1)))
    assert q.mirror_fn is not None
    values, domain = jax.jit(q.network.apply), np.asarray(jax.jit(q.domain_fn)(obs.hand))
    here, there = (np.asarray(values({"params": params}, x))[0, ..., 0] for x in (inputs, jax.jit(q.mirror_fn)(inputs)))
    np.testing.assert_array_equal(domain, (here != 0) & (there[::-1] != 0))
    mask = grid.half_ring(np.array(hand, np.float32), r_in=0.04, r_out=0.2, full=full_ring)
    assert not (mask & ~domain).any()


def test_untrained_it_promises_its_bias_everywhere_and_learns_in_every_layer():
    config = PRESETS["cpu"]
    q = make_q_function(config.network, config.task, ACTIONS)
    params = jax.jit(q.init)(jax.random.key(0, impl="rbg"))
    assert num_parameters(params) == 117_922  # also the size that config.py and README name
    values = np.asarray(jax.jit(q.values)(params, observation(START), jnp.int32(0)))
    mask = grid.half_ring(np.array(START, np.float32), r_in=config.task.r_in, r_out=config.task.r_out)
    np.testing.assert_allclose(values[mask], 0.5, atol=0.05)
    look = jax.jit(q.input_fn)
    inputs = jax.tree.map(lambda x: np.asarray(x)[None], look(observation((-0.1025, 0.0025)), jnp.int32(0)))
    gradient = jax.jit(jax.grad(lambda p: q.at(p, inputs, jnp.array([2 * (50 * 100 + 50)]))[0]))(params)
    flat = {"/".join(str(k.key) for k in path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(gradient)}
    silent = {name for name, leaf in flat.items() if not np.any(np.asarray(leaf))}
    assert all(name.startswith("block") and "_in/" in name for name in silent), silent


def test_paper_and_compact_answer_alike():
    obs = observation((-0.1, 0.0))
    for architecture in ("paper", "compact"):
        q = make_q_function(
            NetworkConfig(architecture=architecture, width=1 / 32, initial_bias=0.2), TaskConfig(), ACTIONS
        )
        params = drawn_params(q.init)
        values = np.asarray(jax.jit(q.values)(params, obs, jnp.int32(0)))
        inputs = jax.tree.map(lambda x: np.asarray(x)[None], jax.jit(q.input_fn)(obs, jnp.int32(0)))
        action = np.array([ACTIONS.encode(np.int32(52), np.int32(40), np.int32(1))])
        np.testing.assert_allclose(jax.jit(q.at)(params, inputs, action)[0], values[52, 40, 1], rtol=1e-4)
        assert values.shape == (100, 100, 2) and values.dtype == jnp.float32


def test_the_mirror_image_of_a_turned_hand_has_the_other_choice():
    """Three choices of which two are each other's reflection: values and augmented pushes change places."""
    made = [Choice(name=str(k), z=0.1, yaw=yaw, aperture=1.0) for k, yaw in enumerate((0.4, 0.0, -0.4))]
    actions = ActionSpace(tuple(made), mirrored=(2, 1, 0))
    obs = observation((-0.1025, 0.0525))
    reflected = reflection(obs, (-0.1025, -0.0525))
    config = NetworkConfig(architecture="compact", width=1 / 16, mirror=True)
    q = make_q_function(config, TaskConfig(), actions)
    params, values = drawn_params(q.init), jax.jit(dataclasses.replace(q, mirror_fn=None).values)
    here, there = (np.asarray(values(params, o, jnp.int32(1))) for o in (obs, reflected))
    assert here.shape == (100, 100, 3)
    reach = np.s_[30:90, 30:70]
    found = np.asarray(jax.jit(q.values)(params, obs, jnp.int32(1)))
    np.testing.assert_allclose(found[reach], ((here + there[::-1, :, ::-1]) / 2)[reach], rtol=1e-4, atol=1e-4)
    push = int(actions.encode(np.int32(60), np.int32(40), np.int32(0)))
    inputs = jax.tree.map(lambda leaf: np.stack([leaf] * 64), jax.jit(q.input_fn)(obs, jnp.int32(1)))
    _, augmented = jax.jit(q.augment)(jax.random.key(0), inputs, jnp.full(64, push))
    assert set(augmented.tolist()) == {push, 3 * (39 * 100 + 40) + 2}
