"""The closing region between the open fingers: which share of an object it holds, against shapely and by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
import shapely.affinity
from scipy.spatial.transform import Rotation

from pregrasp_jax.assets.bank import ConvexObject, make_bank
from pregrasp_jax.assets.catalogue import builtin_bank
from pregrasp_jax.robot import closing_region, get_robot
from pregrasp_jax.robot.ur5e_rg2 import FINGER_CLOSED, FINGER_OPEN

ROBOT = get_robot("ur5e_rg2")


@pytest.fixture(scope="module")
def bank():
    """A 40 x 40 mm box, then objects of 1 to 6 random hulls, some of them apart from each other."""
    corners = np.array([[x, y, z] for x in (-0.02, 0.02) for y in (-0.02, 0.02) for z in (0, 0.15)])

    rng = np.random.default_rng(1)

    def part():
        return rng.normal(size=(24, 3)) * rng.uniform(0.008, 0.03, 3) + rng.uniform(-0.03, 0.03, 3) + [0, 0, 0.1]

    random = [ConvexObject(f"random_{i}", [part() for _ in range(i)]) for i in range(1, 7)]
    return make_bank([ConvexObject("box", [corners]), *random])


def region(aperture):
    assert ROBOT.closing_region is not None
    return ROBOT.closing_region(jnp.float32(aperture))


REGION = region(FINGER_OPEN)


def bounds():
    """Lowest and highest corner of the region, which is a rectangle."""
    assert np.ptp(REGION.half_width) == 0
    return np.array([REGION.x[0], -REGION.half_width[0]]), np.array([REGION.x[-1], REGION.half_width[0]])


def shapely_coverage(bank, object_id, pose, hand_pose):
    low, high = bounds()
    heading = Rotation.from_quat(hand_pose[3:], scalar_first=True).as_matrix()[:2, 0]
    axes = np.stack([heading, [-heading[1], heading[0]]]) / np.linalg.norm(heading)
    polygons = []
    for hull in np.asarray(bank.object_hulls)[object_id]:
        if hull >= 0:
            world = (
                Rotation.from_quat(pose[3:], scalar_first=True).apply(np.asarray(bank.full.vertices[hull])) + pose[:3]
            )
            polygons.append(shapely.MultiPoint((world[:, :2] - hand_pose[:2]) @ axes.T).convex_hull)
    union = shapely.union_all(polygons)
    return union.intersection(shapely.box(*low, *high)).area / union.area


def test_bounds_are_palm_to_fingertip():
    low, high = bounds()
    np.testing.assert_allclose(low, [0.1456 - 0.172, -0.055], atol=1e-9)
    np.testing.assert_allclose(high, [0.2311 - 0.172, 0.055], atol=1e-9)


def test_there_is_a_region_between_open_fingers_only():
    exists = [bool(region(share * FINGER_OPEN).exists) for share in (0.0, 0.5, 0.99, 1.0)]
    assert exists == [False, False, False, True] and not region(FINGER_CLOSED).exists


scene_coverage = jax.jit(closing_region.scene_coverage)


def test_coverage_is_shapelys(bank):
    found, wanted, rng = [], [], np.random.default_rng(2)
    for yaw in rng.uniform(-np.pi, np.pi, 12):
        ids = rng.integers(0, len(bank.names), 8).astype(np.int32)
        poses = np.zeros((8, 7), np.float32)
        poses[:, :3] = rng.uniform(-0.07, 0.07, (8, 3))
        tilt = np.column_stack([0.2 * rng.normal(size=(8, 2)), rng.uniform(-3, 3, 8)])
        poses[:, 3:] = Rotation.from_rotvec(tilt).as_quat(scalar_first=True)
        hand = np.array([0.02, -0.01, 0.1, np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)], np.float32)
        found.append(np.asarray(scene_coverage(bank, ids, poses, hand, REGION)))
        wanted.append([shapely_coverage(bank, i, p, hand) for i, p in zip(ids, poses, strict=True)])
    found, wanted = np.concatenate(found), np.concatenate(wanted)
    np.testing.assert_allclose(found, wanted, atol=0.004)
    assert (wanted == 0).any() and (wanted > 0.9).any() and ((wanted > 0.2) & (wanted < 0.8)).any()


def test_the_share_of_fitting_yaws_is_shapelys():
    """Every object flush against the palm, centred between the fingers, at every tenth degree."""
    bank, (low, high) = builtin_bank("seen"), bounds()
    found = closing_region.fitting_yaws(bank, REGION)
    for index in range(len(bank.names)):
        hulls = np.asarray(bank.object_hulls)[index]
        points = np.asarray(bank.full.vertices)[hulls[hulls >= 0]][..., :2]
        fits = []
        for yaw in np.radians(np.arange(0, 360, 10)):
            turned = points @ np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
            shape = shapely.union_all([shapely.MultiPoint(hull).convex_hull for hull in turned])
            left, bottom, _, top = shape.bounds
            moved = shapely.affinity.translate(shape, low[0] - left, -(bottom + top) / 2)
            fits.append(moved.intersection(shapely.box(*low, *high)).area / shape.area > 0.97)
        assert found[index] == pytest.approx(np.mean(fits), abs=0.06), bank.names[index]
    assert ((found > 0.1) & (found < 0.9)).sum() >= 3 and (found == 1).any()


def test_coverage_by_hand(bank):
    """A 40 x 40 mm box: whole, cut by the palm, cut by the side, outside; empty slots give 0."""
    low, high = bounds()
    centres = [[0.01, 0], [low[0], 0], [0.0, high[1] - 0.01], [high[0] + 0.03, 0], [0.01, 0]]
    wanted = [1.0, 0.5, 0.75, 0.0, 0.0]
    poses = np.zeros((8, 7), np.float32)
    poses[:, 3] = 1
    poses[:5, :2] = centres
    poses[:, 0] += 0.1
    ids = np.array([0, 0, 0, 0, -1, -1, -1, -1], np.int32)
    hand = np.array([0.1, 0, 0.1, 1, 0, 0, 0], np.float32)
    found = np.asarray(scene_coverage(bank, ids, poses, hand, REGION))
    np.testing.assert_allclose(found[:5], wanted, atol=1e-3)
    assert found[0] == pytest.approx(1.0, abs=1e-6) and (found[4:] == 0).all()


def test_union_counts_overlap_once():
    # Two equal intervals, one inside them, one touching, one apart, one empty.
    bottom = jnp.array([0.0, 0.0, 0.25, 1.0, 3.0, 5.0])[:, None]
    top = jnp.array([1.0, 1.0, 0.5, 2.0, 3.5, 4.0])[:, None]
    assert float(closing_region._union_length(bottom, top)[0]) == pytest.approx(2.5)
    order = np.random.default_rng(3).permutation(6)
    assert float(closing_region._union_length(bottom[order], top[order])[0]) == pytest.approx(2.5)
