"""What a planner remembers: an object that the hand hides stays as large as it was, where the rest of it is."""

# Host arrays stand for device arrays here, and every shape is known.
# pyright: reportArgumentType=false, reportOptionalMemberAccess=false

import numpy as np
import pytest

from pregrasp_jax.planning.memory import NOTHING, Memory, Sight, look, solids_of
from pregrasp_jax.planning.rebuild import draw_variants, hidden_cells
from pregrasp_jax.planning.solids import area
from pregrasp_jax.robot.base import hand_pose_of
from pregrasp_jax.spaces import grid
from pregrasp_jax.types import ROBOT_ID, Observation

ROW, COL = np.indices((grid.GRID_SIZE, grid.GRID_SIZE))
XY = grid.cell_to_world(ROW, COL)
HAND = hand_pose_of((-0.3, 0.0), z=0.1, yaw=0.0, aperture=1.2)
NO_ROBOT = np.zeros((0, 4, 3))


def box(x: float, y: float, yaw: float, size: tuple[float, float] = (0.09, 0.05)) -> np.ndarray:
    """Return the cells [H, W] bool of a box that stands on the table."""
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    return (np.abs((XY - [x, y]) @ turn) < np.array(size) / 2).all(axis=-1)


def picture(boxes: list[np.ndarray], *, robot: np.ndarray | None = None, height: float = 0.15) -> Sight:
    ids = np.zeros(ROW.shape, np.uint8)
    for slot, mask in enumerate(boxes):
        ids[mask] = slot + 1
    z = np.where(ids > 0, height, 0.0)
    if robot is not None:
        ids[robot], z[robot] = ROBOT_ID, 0.2
    return Sight(Observation(grid.quantize_height(z), ids, HAND), np.zeros(8), 0)


def remember(sight: Sight, memory: Memory = NOTHING) -> Memory:
    return look(sight, memory, hidden=hidden_cells(sight.obs, None), camera=None)


def test_what_the_hand_hides_keeps_its_size_and_place():
    memory = remember(picture([box(0.0, 0.0, 0.3)]))
    hand = XY[..., 0] < 0.01  # a third of it
    moved = remember(picture([box(0.02, 0.01, 0.8)], robot=hand), memory)
    blind = remember(picture([box(0.02, 0.01, 0.8)], robot=hand))
    true = 0.09 * 0.05
    assert area(moved[0].solids.support[0, 0]) == pytest.approx(true, rel=0.08)
    assert area(blind[0].solids.support[0, 0]) < 0.85 * true
    np.testing.assert_allclose(moved[0].pose[:2], [0.02, 0.01], atol=3e-3)
    assert abs((moved[0].pose[2] - 0.5 + np.pi / 2) % np.pi - np.pi / 2) < 0.1
    assert np.linalg.norm(blind[0].pose[:2] - [0.02, 0.01]) > 5e-3


def test_what_stands_across_the_border_of_the_picture_keeps_its_size():
    memory = remember(picture([box(0.15, 0.0, 0.3)]))
    moved = remember(picture([box(0.225, 0.03, 0.6)]), memory)
    assert area(moved[0].solids.support[0, 0]) == area(memory[0].solids.support[0, 0])
    np.testing.assert_allclose(moved[0].pose[:2], [0.225, 0.03], atol=3e-3)


def test_what_is_hidden_entirely_stays_where_it_was():
    memory = remember(picture([box(0.0, 0.0, 0.3)]))
    after = remember(picture([box(0.0, 0.0, 0.3)], robot=np.ones(ROW.shape, bool)), memory)
    assert after[0] is memory[0]


def test_what_fell_is_seen_anew():
    memory = remember(picture([box(0.0, 0.0, 0.0)]))
    fallen = remember(picture([box(0.05, 0.0, 0.0, size=(0.15, 0.05))], height=0.05), memory)
    assert fallen[0].solids.height[0, 1] == pytest.approx(0.05, abs=2e-3)
    assert area(fallen[0].solids.support[0, 0]) == pytest.approx(0.15 * 0.05, rel=0.05)


def test_slots_that_were_never_seen_stay_empty():
    memory = remember(picture([box(0.0, 0.0, 0.0), box(0.1, 0.1, 0.0)]))
    solids, known = solids_of(memory)
    assert known.tolist() == [True, True] + [False] * 6
    assert solids.support.shape[0] == 8
    variants = draw_variants(memory, NO_ROBOT, 3, np.random.default_rng(0))
    assert (np.asarray(variants.bank.object_hulls)[:, 0] >= 0).tolist() == ([True] * 2 + [False] * 6) * 3


def test_the_first_variant_is_what_was_seen_and_the_others_differ():
    memory = remember(picture([box(0.0, 0.0, 0.3), box(0.1, 0.1, 0.0)]))
    drawn = [draw_variants(memory, NO_ROBOT, 3, np.random.default_rng(seed)) for seed in (0, 1)]
    np.testing.assert_array_equal(drawn[0].poses[0], drawn[1].poses[0])
    np.testing.assert_allclose(drawn[0].poses[0, 0, :2], [0.0, 0.0], atol=1e-3)
    off = np.linalg.norm(drawn[0].poses[1:, :2, :2] - drawn[0].poses[:1, :2, :2], axis=-1)
    assert (off > 1e-4).all() and (off < 0.012).all()
    mass = np.asarray(drawn[0].bank.mass).reshape(3, 8)
    assert mass[0, 0] == pytest.approx(300 * 0.15 * 0.09 * 0.05, rel=0.06)
    assert (np.abs(mass[1:, 0] / mass[0, 0] - 1) > 1e-3).all()
    friction = np.asarray(drawn[0].bank.friction).reshape(3, 8)
    np.testing.assert_allclose(friction[0], 0.25)
    assert (np.abs(friction[1:] - 0.25) > 1e-4).all() and (np.abs(np.log(friction / 0.25)) <= np.log(1.4) + 1e-6).all()
    width = np.ptp(np.asarray(drawn[0].bank.full.vertices)[:, :, :2].reshape(3, 8, -1, 2)[:, 0], axis=1)
    assert len(np.unique(np.round(width / width[:1], 4), axis=0)) == 3, "sides differ, not sizes alone"
    assert (np.abs(width[1:, 0] / width[0, 0] - width[1:, 1] / width[0, 1]) > 1e-4).all()


def test_a_camera_does_not_see_the_table_behind_a_tower():
    sight = picture([box(0.1, 0.0, 0.0, size=(0.04, 0.04))], height=0.25)
    hidden = hidden_cells(sight.obs, np.array([0.0, 0.0, 1.0]))
    rows, cols = grid.world_to_cell(np.array([[0.135, 0.0], [0.06, 0.0]]))
    assert hidden[rows, cols].tolist() == [True, False]
    assert not hidden_cells(sight.obs, None).any()
