"""Frustums: faces, volume and inertia against convex hulls, and what separates them."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from pregrasp_jax.assets.measure import measure
from pregrasp_jax.planning import outlines, separate
from pregrasp_jax.planning.solids import (
    MIN_SIDE,
    NUM_SIDES,
    Frustums,
    area,
    corners,
    directions,
    hull_bank,
    mass_properties,
    planes,
    tighten,
    vertices,
)
from pregrasp_jax.spaces import grid
from pregrasp_jax.types import MAX_HULLS


def ellipse(a: float, b: float) -> np.ndarray:
    x, y = directions(np.float64(0.0)).T
    return np.hypot(a * x, b * y)


def one(bottom: np.ndarray, top: np.ndarray, height: tuple[float, float] = (0.0, 0.1), angle: float = 0.2) -> Frustums:
    """An object of one frustum."""
    support = np.broadcast_to(np.stack([bottom, top]), (MAX_HULLS, 2, NUM_SIDES))
    heights = np.broadcast_to(np.array(height), (MAX_HULLS, 2))
    return Frustums(support, heights, np.full(MAX_HULLS, angle), np.arange(MAX_HULLS) == 0)


def many(*solids: Frustums) -> Frustums:
    return Frustums(*(np.stack(columns) for columns in zip(*solids, strict=True)))


def separated(solids: Frustums, poses: np.ndarray, robot: np.ndarray) -> Frustums:
    """The objects of one scene."""
    found = separate.separate(many(solids), poses[None], robot)
    return Frustums(*(leaf[0] for leaf in found))


def test_vertices_lie_on_their_faces_and_make_a_convex_hull():
    solid = one(ellipse(0.04, 0.03), ellipse(0.02, 0.025))
    points, faces = vertices(solid)[0], planes(solid)[0]
    distance = points @ faces[:, :3].T - faces[:, 3]
    assert distance.max() < 1e-12
    assert ((distance > -1e-12).sum(axis=0) == [4] * NUM_SIDES + [NUM_SIDES] * 2).all()
    np.testing.assert_allclose(np.linalg.norm(faces[:, :3], axis=1), 1.0)
    assert len(ConvexHull(points).vertices) == len(points)


def test_mass_properties_agree_with_those_of_the_hull():
    solid = one(ellipse(0.04, 0.03), ellipse(0.02, 0.025))
    found = mass_properties(many(solid))
    hull = measure(vertices(solid)[:1], planes(solid)[:1])
    assert found.volume[0] == pytest.approx(ConvexHull(vertices(solid)[0]).volume, rel=1e-9)
    np.testing.assert_allclose(found.com[0], hull.com, atol=1e-4)
    np.testing.assert_allclose(found.inertia[0], hull.inertia, atol=0.03 * hull.inertia.max())


def test_tightening_keeps_the_polygon_but_for_short_sides():
    support = ellipse(0.04, 0.03)
    loose = support.copy()
    loose[3] += 0.01  # a side that touches nothing
    tight = tighten(loose)
    around = corners(tight, np.float64(0.0))
    length = np.linalg.norm(around - np.roll(around, 1, axis=0), axis=1)
    assert length.min() >= 0.99 * MIN_SIDE
    assert (tight <= loose).all()
    inside = around @ directions(np.float64(0.0)).T
    np.testing.assert_allclose(inside.max(axis=0), tight, atol=1e-9)
    np.testing.assert_allclose(area(tight), ConvexHull(around).volume)


XY = grid.cell_to_world(*np.divmod(np.arange(grid.GRID_SIZE**2), grid.GRID_SIZE))
"""[H W, 2] m, centres of all cells."""


def rebuilt(inside: np.ndarray, height: np.ndarray | float) -> Frustums:
    """What is made of the cells [H W] bool of an object with `height` [H W] m."""
    return outlines.stack(XY[inside], np.broadcast_to(height, inside.shape)[inside], XY[~inside])


CAN, CARTON, BOTTLE = (0.035, 0.035, 0.035), (0.03, 0.03, 0.006), (0.048, 0.033, 0.012)
"""Half sizes and the radius of the corners, m."""


@pytest.mark.parametrize(("length", "width", "rounding"), [CAN, CARTON, BOTTLE])
def test_sides_are_off_by_a_quarter_of_a_cell(length: float, width: float, rounding: float):
    """Wherever and however an object stands."""
    rng = np.random.default_rng(0)
    core = np.array([length, width]) - rounding
    off, extent = [], []
    for _ in range(60):
        centre, turn = rng.uniform(-0.05, 0.05, 2), rng.uniform(0, np.pi)
        axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        inside = np.linalg.norm(np.maximum(np.abs((XY - centre) @ axes.T) - core, 0), axis=1) <= rounding
        solids = rebuilt(inside, 0.1)
        normal = directions(np.linspace(0, 2 * np.pi, 25)[:-1])[:, 0]
        around = corners(tighten(solids.support[:, 0]), solids.angle[:, None])[solids.present].reshape(-1, 2)
        found = (around @ normal.T).max(axis=0)
        true = normal @ centre + np.abs(normal @ axes.T) @ core + rounding
        off.append(found - true)
        extent.append((found - true)[:12] + (found - true)[12:])
    assert abs(np.mean(off)) < 7e-4 and np.std(off) < 1.3e-3
    assert np.quantile(extent, 0.05) > -3e-3, "as wide as it is, or a hand that is too narrow for it seems to fit"


@pytest.mark.parametrize(("shape", "least"), [("round", 0.9), ("square", 0.88)])
def test_outline_has_size_and_shape_of_the_object(shape: str, least: float):
    """Least where a square stands along the cells: each of its sides may be half a cell off."""
    rng = np.random.default_rng(0)
    fine = np.stack(np.meshgrid(*[np.linspace(-0.1, 0.1, 201)] * 2), axis=-1).reshape(-1, 2)
    share, size = [], []
    for _ in range(20):
        centre, turn = rng.uniform(-0.05, 0.05, 2), rng.uniform(0, np.pi)

        def inside(points: np.ndarray, centre: np.ndarray = centre, turn: float = turn) -> np.ndarray:
            local = (points - centre) @ np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
            return np.linalg.norm(local, axis=1) < 0.035 if shape == "round" else np.abs(local).max(axis=1) < 0.03

        cells, others = XY[inside(XY)], XY[~inside(XY)]
        angle = outlines.turn_of(cells)
        found = (fine @ directions(np.float64(angle)).T <= outlines.outline(cells, others, angle)).all(axis=1)
        share.append((found & inside(fine)).sum() / (found | inside(fine)).sum())
        size.append(found.sum() / inside(fine).sum())
    assert np.mean(share) > 0.94 and min(share) > least
    assert abs(np.mean(size) - 1) < 0.015


def test_layers_follow_a_bottle():
    radius = np.linalg.norm(XY, axis=1)
    height = np.select([radius < 0.015, radius < 0.04], [0.25, 0.15], 0.0)  # a neck on a body
    found = rebuilt(height > 0, height)
    assert found.present.sum() == 2
    np.testing.assert_allclose(found.height[:2].ravel(), [0, 0.15, 0.15, 0.25], atol=0.013)
    np.testing.assert_allclose(found.support[:2].mean(axis=(1, 2)), [0.04, 0.015], atol=1.5e-3)


def test_what_is_small_or_flat_is_an_object_still():
    corner = grid.cell_to_world(np.array([50, 50, 51]), np.array([50, 51, 50]))
    for count in (1, 2, 3):
        found = rebuilt((XY[:, None] == corner[:count]).all(axis=-1).any(axis=1), 0.0)
        assert found.present.sum() == 1 and found.height[0].tolist() == [0.0, 0.01]
        assert (area(tighten(found.support[0])) > 1e-5).all()


def test_a_handle_is_a_part_of_its_own():
    handle = (np.abs(XY[:, 1]) < 0.008) & (XY[:, 0] > 0) & (XY[:, 0] < 0.085)
    inside = (np.linalg.norm(XY, axis=1) < 0.04) | handle
    found = rebuilt(inside, 0.12)
    assert found.present.sum() == 2
    total = area(found.support[:2, 0]).sum()
    assert total == pytest.approx(inside.sum() * grid.HEIGHTMAP_RESOLUTION**2, rel=0.05)


def test_objects_that_overlap_are_cut_back_where_it_takes_least():
    square = one(np.full(NUM_SIDES, 0.03), np.full(NUM_SIDES, 0.03), angle=0.0)
    solids = many(square, square, square)
    poses = np.array([[0.0, 0.0, 0.0], [0.055, 0.0, 0.4], [0.3, 0.0, 0.0]])
    robot = np.array([[[-0.1, -0.01, z], [-0.025, -0.01, z], [-0.1, 0.01, z], [-0.025, 0.01, z]] for z in (0.05, 0.5)])
    found = separated(solids, poses, robot.reshape(2, 4, 3))
    points = [corners(found.support[i, 0, 0], np.float64(poses[i, 2])) + poses[i, :2] for i in range(3)]
    # What separates them: the largest gap over the directions of either.
    gap = max((points[1] @ n).min() - (points[0] @ n).max() for n in directions(np.linspace(0, 0.4, 9)).reshape(-1, 2))
    assert -5e-4 < gap < 2e-3
    np.testing.assert_array_equal(found.support[2], tighten(solids.support[2]))  # one that touches nothing


def test_scenes_do_not_depend_on_each_other():
    square = one(np.full(NUM_SIDES, 0.03), np.full(NUM_SIDES, 0.02))
    disc = one(ellipse(0.03, 0.04), ellipse(0.02, 0.03))
    scenes = many(many(square, disc, square), many(disc, square, disc))
    poses = np.array([[[0, 0, 0], [0.05, 0, 0.4], [0.3, 0, 0]], [[0.2, 0, 0], [0, 0.03, 1.0], [0, 0, 0]]])
    finger = np.array([[[x, y, z] for x in (-0.01, 0.012) for y in (-0.01, 0.01) for z in (0.0, 0.2)]])
    together = separate.separate(scenes, poses, finger)
    for index in range(2):
        alone = separated(Frustums(*(leaf[index] for leaf in scenes)), poses[index], finger)
        np.testing.assert_allclose(together.support[index], alone.support, atol=1e-6)
        assert (alone.support < scenes.support[index] - 1e-3).any()


def test_what_is_cut_from_all_sides_stays_a_solid():
    """A finger that seems to stand in the middle of an object, and neighbours that seem to cover it."""
    square = one(np.full(NUM_SIDES, 0.03), np.full(NUM_SIDES, 0.02), angle=0.0)
    poses = np.array([[0.0, 0.0, 0.0], [0.01, 0.0, 0.4], [-0.01, 0.003, 1.0], [0.0, -0.01, 0.0]])
    finger = np.array([[[x, y, z] for x in (-0.01, 0.012) for y in (-0.01, 0.01) for z in (0.0, 0.2)]])
    found = separated(many(square, square, square, square), poses, finger)
    assert (area(found.support[:, 0, 0]) > 2e-5).all() and (area(found.support[:, 0, 1]) > 2e-5).all()
    for i in range(4):
        around = corners(found.support[i, 0], np.zeros(2)).reshape(-1, 2)
        assert np.abs(around).max() < 0.035
    bank = hull_bank(found, density=np.full(4, 300.0), friction=np.full(4, 0.25))
    assert (np.asarray(bank.mass) > 0).all() and (np.asarray(bank.mass) < 0.2).all()


def test_the_robot_cuts_only_what_is_as_high_as_it_is():
    square = one(np.full(NUM_SIDES, 0.03), np.full(NUM_SIDES, 0.03), angle=0.0)
    finger = np.array([[x, y, z] for x in (-0.1, -0.02) for y in (-0.01, 0.01) for z in (0.08, 0.12)])
    for lift, reach in ((0.0, -0.02), (0.1, -0.03)):
        found = separated(many(square), np.zeros((1, 3)), finger[None] + [0, 0, lift])
        assert corners(found.support[0, 0, 0], np.float64(0.0))[:, 0].min() == pytest.approx(reach, abs=5e-4)


def test_bank_of_objects_measures_what_it_is():
    solid = one(ellipse(0.04, 0.03), ellipse(0.04, 0.03))
    bank = hull_bank(many(solid, solid), density=np.array([300.0, 600.0]), friction=np.array([0.25, 0.3]))
    assert bank.mass[1] == pytest.approx(2 * bank.mass[0])
    assert bank.mass[0] == pytest.approx(300 * 0.1 * float(area(solid.support[0, 0])), rel=1e-6)
    assert (np.asarray(bank.object_hulls) >= 0).sum(axis=1).tolist() == [1, 1]
