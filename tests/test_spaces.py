"""Actions and workspaces: what an index means, for numpy and jax alike, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pregrasp_jax.spaces import grid
from pregrasp_jax.spaces.actions import ActionSpace, Choice
from pregrasp_jax.spaces.workspace import TABLE, WORKSPACES, Box, Workspace, get_workspace

TWO = ActionSpace(
    (Choice(name="closed", z=0.1, yaw=0.0, aperture=0.0), Choice(name="open", z=0.1, yaw=0.0, aperture=1.2)),
    mirrored=(0, 1),
)
FIVE = ActionSpace(
    tuple(
        Choice(name=f"{k}", z=0.1 + 0.01 * k, yaw=yaw, aperture=aperture)
        for k, (yaw, aperture) in enumerate(((0.5, 0.3), (0.0, 0.9), (-0.5, 0.3), (0.2, 0.9), (-0.2, 0.0)))
    ),
    mirrored=(2, 1, 0, 4, 3),
)


@pytest.mark.parametrize("actions", [TWO, FIVE], ids=["2", "5"])
@pytest.mark.parametrize("xp", [np, jnp], ids=["numpy", "jax"])
def test_an_index_is_a_cell_and_a_choice(actions, xp):
    num = actions.num_choices
    assert actions.shape == (100, 100, num)
    row, col, choice = (xp.asarray(x) for x in np.indices(actions.shape).reshape(3, -1))
    flat = actions.encode(row, col, choice)
    assert flat.dtype == np.int32 and isinstance(flat, type(row))
    np.testing.assert_array_equal(flat, np.arange(100 * 100 * num), "in the order of Q[row, col, choice]")
    for found, expected in zip(actions.unravel(flat), (row, col, choice), strict=True):
        np.testing.assert_array_equal(found, expected)
    one = actions.encode(xp.asarray(7), xp.asarray(31), xp.asarray(1))
    assert int(one) == (7 * 100 + 31) * num + 1
    xy, held = actions.decode(xp.asarray(one))
    np.testing.assert_allclose(xy, [-0.25 + 0.005 * 31.5, -0.25 + 0.005 * 7.5], atol=1e-6)
    assert int(held) == 1


@pytest.mark.parametrize("xp", [np, jnp], ids=["numpy", "jax"])
def test_a_reflected_push_is_in_the_reflected_row_with_the_reflected_choice(xp):
    push = FIVE.encode(xp.asarray(7), xp.asarray(31), xp.asarray(0))
    assert [int(x) for x in FIVE.unravel(FIVE.mirror(push))] == [92, 31, 2]
    everything = xp.arange(100 * 100 * 5)
    np.testing.assert_array_equal(FIVE.mirror(FIVE.mirror(everything)), everything)
    (x, y), choice = FIVE.decode(push)
    (mirrored_x, mirrored_y), mirrored = FIVE.decode(FIVE.mirror(push))
    np.testing.assert_allclose([mirrored_x, mirrored_y], [x, -y], atol=1e-6)
    assert FIVE.choices[int(mirrored)].yaw == -FIVE.choices[int(choice)].yaw


@pytest.mark.parametrize("actions", [TWO, FIVE], ids=["2", "5"])
@pytest.mark.parametrize("xp", [np, jnp], ids=["numpy", "jax"])
def test_a_mirrored_map_has_at_every_push_what_the_other_has_at_its_reflection(actions, xp):
    q = xp.asarray(np.random.default_rng(0).normal(size=(3, *actions.shape)).astype(np.float32))
    mirrored = np.asarray(actions.mirror_map(q)).reshape(3, -1)
    reflection = np.asarray(actions.mirror(np.arange(mirrored.shape[1])))
    np.testing.assert_array_equal(mirrored, np.asarray(q).reshape(3, -1)[:, reflection])


def test_how_the_hand_is_held():
    for choices in (np.array([4, 0]), jnp.array([4, 0])):
        z, yaw, aperture = FIVE.held(choices)
        np.testing.assert_array_equal([z, yaw, aperture], np.array([[0.14, 0.10], [-0.2, 0.5], [0.0, 0.3]], np.float32))
        assert z.dtype == yaw.dtype == aperture.dtype == np.float32
    assert float(jax.jit(FIVE.held)(jnp.int32(3))[0]) == float(np.float32(0.13))
    assert (FIVE.widest, FIVE.narrowest) == (1, 4) and (TWO.widest, TWO.narrowest) == (1, 0)


@pytest.mark.parametrize(
    ("names", "mirrored", "said"),
    [
        ((), (), r"are \[\]; allowed are one or more of different names"),
        (("a", "b", "a"), (0, 1, 2), r"are \['a', 'b', 'a'\]; allowed are one or more of different names"),
        (("a", "b"), (0,), r"mirrored = \(0,\); allowed is an order of 0 to 1"),
        (("a", "b"), (1, 1), r"mirrored = \(1, 1\); allowed is an order of 0 to 1"),
        (("a", "b"), (1, 2), r"mirrored = \(1, 2\); allowed"),
        (("a", "b", "c"), (1, 2, 0), r"mirrored = \(1, 2, 0\); allowed .* undoes itself"),
    ],
)
def test_spaces_that_make_no_sense_are_refused(names, mirrored, said):
    with pytest.raises(ValueError, match=said):
        ActionSpace(tuple(Choice(name=name, z=0.1, yaw=0.0, aperture=0.0) for name in names), mirrored=mirrored)


def test_grid_functions_serve_numpy_and_jax_alike():
    points = np.array([[-0.2499, 0.2499], [0.0024, -0.1]], np.float32)
    for xp in (np, jnp):
        row, col = grid.world_to_cell(xp.asarray(points))
        np.testing.assert_array_equal([row, col], [[99, 30], [0, 50]])
        ring = grid.half_ring(xp.asarray([-0.1, 0.03]), r_in=0.04, r_out=0.15, yaw=0.4)
        np.testing.assert_array_equal(ring, grid.half_ring(np.array([-0.1, 0.03]), r_in=0.04, r_out=0.15, yaw=0.4))
        assert ring.any()
        heights = grid.quantize_height(xp.asarray([-1.0, 0.06, 0.30, 0.9]))
        np.testing.assert_array_equal(heights, [0, 51, 255, 255])
        np.testing.assert_allclose(grid.dequantize_height(heights), [0, 0.06, 0.3, 0.3], atol=1e-6)


POINTS = [
    ([0.25, -0.25, 0.0], False),
    ([0.2501, 0.0, 0.1], True),
    ([-0.2501, 0.0, 0.1], True),
    ([0.0, 0.2501, 0.1], True),
    ([0.0, -0.2501, 0.1], True),
    ([0.0, 0.0, -0.001], True),
    ([0.1, 0.2, 5.0], False),
]


@pytest.mark.parametrize("xp", [np, jnp], ids=["numpy", "jax"])
def test_what_has_left_the_table(xp):
    points = xp.asarray(np.array([point for point, _ in POINTS], np.float32))
    np.testing.assert_array_equal(TABLE.has_left(points), [left for _, left in POINTS])
    shelf = Workspace(name="shelf", low=(-0.25, -np.inf), high=(np.inf, 0.1))
    found = shelf.has_left(xp.asarray(np.array([[9.0, -9.0, 0.0], [0.0, 0.11, 0.0], [-0.26, 0.0, 0.0]], np.float32)))
    np.testing.assert_array_equal(found, [False, True, True])


def test_corners_of_a_wall_and_its_distance_to_the_origin():
    wall = Box(center=(0.5, 0.2, 0.3), half_size=(0.1, 0.02, 0.3))
    corners = wall.corners()
    np.testing.assert_allclose(corners.min(axis=0), [0.4, 0.18, 0.0])
    np.testing.assert_allclose(corners.max(axis=0), [0.6, 0.22, 0.6])
    assert wall.distance_to_origin() == pytest.approx(np.hypot(0.4, 0.18))
    turned = Box(center=(0.5, 0.2, 0.3), half_size=(0.1, 0.02, 0.3), yaw=np.pi / 6)
    np.testing.assert_allclose(
        turned.corners()[-1], [0.5 + 0.1 * np.sqrt(0.75) - 0.01, 0.25 + 0.02 * np.sqrt(0.75), 0.6]
    )
    # Points of its outline, one by one.
    root = np.sqrt(0.75)
    axes = np.array([[root, 0.5], [-0.5, root]])
    local = np.stack(np.meshgrid(np.linspace(-0.1, 0.1, 2001), np.linspace(-0.02, 0.02, 401)), axis=-1).reshape(-1, 2)
    nearest = np.linalg.norm(local @ axes + [0.5, 0.2], axis=1).min()
    assert turned.distance_to_origin() == pytest.approx(nearest, abs=1e-6)
    assert Box(center=(0.05, 0.0, 0.1), half_size=(0.1, 0.1, 0.1), yaw=1.0).distance_to_origin() == 0.0


@pytest.mark.parametrize(
    "change",
    [
        {"half_size": (0.1, 0.0, 0.1)},
        {"half_size": (0.1, -0.1, 0.1)},
        {"center": (np.nan, 0.0, 0.0)},
        {"half_size": (np.inf, 0.1, 0.1)},
        {"yaw": np.inf},
    ],
)
def test_walls_that_make_no_sense_are_refused(change):
    with pytest.raises(ValueError, match=r"wall at .*; allowed are finite numbers and half sizes above 0"):
        Box(**({"center": (0.0, 0.0, 0.0), "half_size": (0.1, 0.1, 0.1)} | change))


@pytest.mark.parametrize("high", [(-0.3, 0.25), (0.25, -0.25), (np.nan, 0.25)])
def test_limits_that_make_no_sense_are_refused(high):
    with pytest.raises(ValueError, match=r"workspace 'x': low = \(-0\.25, -0\.25\) must be below high"):
        Workspace(name="x", high=high)


def test_places_are_found_by_name(monkeypatch):
    assert get_workspace("table") is TABLE and not TABLE.walls
    room = Workspace(name="room")
    monkeypatch.setitem(WORKSPACES, "room", room)
    assert get_workspace("room") is room
    with pytest.raises(
        ValueError, match=r"task\.workspace = 'moon' does not exist; allowed: narrow, room, shelf, table"
    ):
        get_workspace("moon")
