"""Random strokes come from beside the clutter; the last one reaches for the target only where nothing is in its way."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from pregrasp_jax.policies import free_space
from pregrasp_jax.policies.free_space import MAX_START, make_cluster, make_feasible
from pregrasp_jax.policies.strokes import guided_stroke, outline, squared_distance
from pregrasp_jax.robot import get_robot
from pregrasp_jax.spaces import grid
from pregrasp_jax.task.push_grasp import HEADINGS, stroke_actions
from pregrasp_jax.types import Observation, SceneParams

ACTIONS = stroke_actions()
ROWS, COLS = np.indices((100, 100))
X, Y = grid.cell_to_world(ROWS, COLS)[..., 0], grid.cell_to_world(ROWS, COLS)[..., 1]


class State:
    """What a last stroke is asked with: ids of the cells of discs, the target first."""

    def __init__(self, *discs):
        ids = np.zeros((100, 100), np.uint8)
        for slot, (x, y, radius) in enumerate(discs):
            ids[np.hypot(X - x, Y - y) <= radius] = slot + 1
        self.obs = Observation(jnp.zeros((100, 100), jnp.uint8), jnp.asarray(ids), None)  # pyright: ignore
        self.scene = SceneParams(jnp.zeros(8, jnp.int32), jnp.zeros((8, 7)), jnp.int32(0))


@pytest.fixture(scope="module")
def feasible():
    final = make_feasible(get_robot("barrett"))
    run = jax.jit(lambda ids: final(with_ids(ids), jax.random.key(0)))

    def with_ids(ids) -> Any:
        state = State()
        state.obs = state.obs.replace(instance_ids=ids)
        return state

    return lambda *discs: run(State(*discs).obs.instance_ids)


def test_distances_and_outlines_are_those_of_scipy():
    mask = np.random.default_rng(0).uniform(size=(100, 100)) > 0.995
    expected: Any = ndimage.distance_transform_edt(np.logical_not(mask))
    np.testing.assert_allclose(np.sqrt(squared_distance(jnp.asarray(mask))), expected, rtol=1e-6)
    assert np.isinf(squared_distance(jnp.zeros((5, 5), bool))).all()
    thick = np.asarray(ndimage.binary_dilation(mask, iterations=4))
    inner = np.asarray(ndimage.binary_erosion(thick))
    np.testing.assert_array_equal(outline(jnp.asarray(thick)), np.logical_and(thick, np.logical_not(inner)))


def test_guided_strokes_begin_in_the_band_and_head_for_the_outline():
    height = 0.15 * (np.hypot(X - 0.02, Y + 0.03) < 0.04) + 0.05 * (np.hypot(X + 0.1, Y) < 0.03)
    draw = jax.jit(jax.vmap(lambda key: guided_stroke(key, jnp.asarray(height, jnp.float32), ACTIONS)))
    strokes = draw(jax.random.split(jax.random.key(0), 500))
    rows, cols, headings = (np.asarray(part) for part in ACTIONS.unravel(strokes.index))
    tall = height > 0.1
    distance = 0.005 * np.asarray(ndimage.distance_transform_edt(np.logical_not(tall)))[rows, cols]
    assert distance.min() > 0.10 and distance.max() < 0.15
    assert np.ptp(np.arctan2(Y[rows, cols] + 0.03, X[rows, cols] - 0.02)) > 6, "from all sides"
    # The disc is seen under an angle of at most 2 asin(0.04 / 0.14) = 33 degrees, and headings are 22.5 apart.
    off = np.arctan2(-0.03 - Y[rows, cols], 0.02 - X[rows, cols]) - 2 * np.pi * headings / HEADINGS
    assert np.abs((off + np.pi) % (2 * np.pi) - np.pi).max() < np.radians(17 + 11.25 + 2)
    apertures = np.asarray(strokes.aperture)
    assert 0.6 <= apertures.min() < 0.62 and 1.08 < apertures.max() <= 1.1


def test_a_lone_target_is_reached_for_and_enclosed(feasible):
    stroke, there_is = feasible((0.05, -0.02, 0.03))
    assert there_is and stroke.final
    ahead = np.array([np.cos(stroke.start.yaw), np.sin(stroke.start.yaw)])
    target = np.array([0.05, -0.02]) - np.asarray(stroke.end.xy)
    assert target @ ahead == pytest.approx(0.035, abs=0.005), "its near side 5 mm ahead of the commanded point"
    assert abs(target @ np.array([-ahead[1], ahead[0]])) < 0.005
    np.testing.assert_allclose(stroke.end.xy - stroke.start.xy, 0.15 * ahead, atol=1e-5)
    assert stroke.start.aperture == pytest.approx(0.6), "of equally good ones the widest"


def test_an_obstacle_on_one_side_is_kept_clear_of(feasible):
    target, obstacle = np.array([0.0, 0.0]), np.array([-0.10, 0.0])
    stroke, there_is = feasible((*target, 0.03), (*obstacle, 0.03))
    assert there_is
    start, end = np.asarray(stroke.start.xy), np.asarray(stroke.end.xy)
    # Independently: the middle of the palm's way passes the obstacle farther away than palm and obstacle are wide.
    way = start + np.linspace(0, 1, 50)[:, None] * (end - start)
    assert np.linalg.norm(way - obstacle, axis=1).min() > 0.0445 + 0.03


def test_a_target_that_is_surrounded_is_not(feasible):
    around = [(0.075 * np.cos(a), 0.075 * np.sin(a), 0.03) for a in np.arange(6) * np.pi / 3]
    assert not feasible((0.0, 0.0, 0.035), *around)[1]
    # Two obstacles beside the heading: the hand could pass, but would enclose them.
    assert not feasible((0.0, 0.0, 0.02), (0.05, 0.0, 0.02), (-0.05, 0.0, 0.02), (0.0, 0.05, 0.02), (0.0, -0.05, 0.02))[
        1
    ]


def test_a_target_too_large_for_the_hand_is_tried_only_when_nothing_else_is_left(feasible):
    assert not feasible((0.0, 0.0, 0.12), (0.2, 0.2, 0.02))[1]
    assert feasible((0.0, 0.0, 0.12))[1]
    for corner in ((-0.2, -0.2), (-0.2, 0.2), (0.2, -0.2), (0.2, 0.2)):
        stroke, there_is = feasible((*corner, 0.12))
        assert there_is and np.abs(stroke.start.xy).max() <= MAX_START, "from where the hand can get to"


def test_without_a_target_in_sight_there_is_no_last_stroke(feasible):
    state = State((0.4, 0.4, 0.03), (0.0, 0.0, 0.03))
    assert not (np.asarray(state.obs.instance_ids) == 1).any()
    assert not feasible((0.4, 0.4, 0.03), (0.0, 0.0, 0.03))[1]


def test_the_cluster_criterion_asks_for_10_mm():
    final = jax.jit(lambda ids, key: make_cluster(None)(with_ids(ids), key))  # pyright: ignore

    def with_ids(ids) -> Any:
        state = State()
        state.obs = state.obs.replace(instance_ids=ids)
        return state

    far, near = (State((0.0, 0.0, 0.03), (0.06 + gap, 0.0, 0.03)).obs.instance_ids for gap in (0.018, 0.005))
    assert final(far, jax.random.key(0))[1] and not final(near, jax.random.key(0))[1]
    for seed in range(5):
        stroke, _ = final(far, jax.random.key(seed))
        start, end = np.asarray(stroke.start.xy), np.asarray(stroke.end.xy)
        np.testing.assert_allclose(end, [0, 0], atol=0.003)
        assert np.linalg.norm(start) - 0.03 + 0.006 > 0.05 and np.linalg.norm(start) <= 0.15 + 1e-6
        assert np.linalg.norm(start - [0.078, 0]) > 0.03
        # A target of 60 mm: 1.531 - 4.677 * 0.06 - 0.05 = 1.2, at most 1.1.
        assert stroke.start.aperture == pytest.approx(1.1, abs=1e-6)


def test_a_hand_without_an_outline_is_refused():
    with pytest.raises(ValueError, match="robot ur5e_rg2 has no outline; allowed for Target-PPG"):
        make_feasible(get_robot("ur5e_rg2"))
    assert pytest.approx(0.0075) == free_space.MARGIN
