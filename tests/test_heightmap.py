import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from heightmap_oracle import box_cloud, cast_rays, make_instances, random_clouds

from pregrasp_jax import heightmap
from pregrasp_jax.heightmap import Camera, HullInstances
from pregrasp_jax.spaces import grid

CAMERA = Camera(position=jnp.array([0.0, 0.0, 1.0]), rotation=jnp.eye(3), fovy=jnp.deg2rad(42.5))
orthographic, pinhole, render_pinhole, unproject = map(
    jax.jit, (heightmap.orthographic, heightmap.pinhole, heightmap.render_pinhole, heightmap.unproject)
)
CENTERS = -0.25 + 0.005 * (np.arange(100) + 0.5)


@pytest.fixture
def clutter() -> HullInstances:
    rng = np.random.default_rng(1)
    # One hull spans more than the grid, some reach out of it, several share a label, two labels share a place.
    clouds = random_clouds(rng, 30) + random_clouds(rng, 1, size=0.3)
    return make_instances(clouds, [1 + k % 9 for k in range(len(clouds))])


def oracle_from_above(instances: HullInstances) -> tuple[np.ndarray, np.ndarray]:
    x, y = np.meshgrid(CENTERS, CENTERS)
    origins = np.stack([x.ravel(), y.ravel(), np.full(x.size, 2.0)], axis=-1)
    distance, labels = cast_rays(instances, origins, np.tile([0.0, 0.0, -1.0], (x.size, 1)))
    seen = (distance >= 0) & (distance < 2.0)
    return np.where(seen, 2.0 - distance, 0.0).reshape(100, 100), np.where(seen, labels, 0).reshape(100, 100)


@pytest.mark.parametrize("jit", [True, False])
def test_box_fills_exactly_its_cells(jit):
    # Not square, off centre, 0.12 m high: swapped axes, flipped rows or a bottom face give other cells.
    box = make_instances([box_cloud((0.05, -0.20, 0.02), (0.10, -0.18, 0.12))], [7])
    height, ids = orthographic(box) if jit else heightmap.orthographic(box)
    expected = np.zeros((100, 100))
    expected[10:14, 60:70] = 1
    np.testing.assert_array_equal(ids, 7 * expected)
    np.testing.assert_allclose(height, 0.12 * expected, atol=1e-6)


def test_slope_has_the_height_of_its_plane():
    points = np.array(
        [[-0.1, -0.1, 0], [0.1, -0.1, 0], [0.1, 0.1, 0], [-0.1, 0.1, 0], [0.1, -0.1, 0.2], [0.1, 0.1, 0.2]]
    )
    height, _ = orthographic(make_instances([points], [1]))
    np.testing.assert_allclose(height[50, 30:70], CENTERS[30:70] + 0.1, atol=1e-6)


def test_highest_surface_wins_in_any_order():
    low, high = box_cloud((-0.1, -0.1, 0), (0.1, 0.1, 0.1)), box_cloud((0.0, -0.05, 0.35), (0.2, 0.05, 0.40))
    for clouds, labels in (([low, high], [3, 4]), ([high, low], [4, 3])):
        height, ids = orthographic(make_instances(clouds, labels))
        assert ids[50, 60] == 4 and ids[50, 40] == 3 and ids[0, 0] == 0
        # Above the clip of the observation the surface still hides what is below it.
        np.testing.assert_allclose(height[50, 60], 0.40, atol=1e-6)
        assert grid.quantize_height(height)[50, 60] == 255


def test_orthographic_agrees_with_mujoco_rays(clutter):
    height, ids = orthographic(clutter)
    expected_height, expected_ids = oracle_from_above(clutter)
    assert 0.3 < (expected_ids > 0).mean() < 0.9
    assert (ids == expected_ids).mean() >= 0.9999
    assert np.abs(height - expected_height)[ids == expected_ids].max() < 5e-6


def test_absent_and_broken_hulls_are_not_drawn(clutter):
    every_other = clutter.replace(present=jnp.arange(31) % 2 == 0)
    _, expected = oracle_from_above(every_other)
    assert (orthographic(every_other)[1] == expected).mean() >= 0.9999
    nan_pose = jnp.where((jnp.arange(31) % 2 == 0)[:, None, None], 0.0, jnp.nan)
    broken = clutter.replace(planes=clutter.planes + nan_pose, vertices=clutter.vertices + nan_pose)
    height, ids = orthographic(broken)
    np.testing.assert_array_equal(ids, orthographic(every_other)[1])
    assert np.isfinite(height).all()
    height, ids = orthographic(clutter.replace(present=jnp.zeros(31, bool)))
    assert not height.any() and not ids.any()


def test_mirror_symmetry_in_y(clutter):
    mirror = jnp.array([1.0, -1.0, 1.0, 1.0])
    mirrored = clutter.replace(
        planes=clutter.planes * mirror[None, None, :], vertices=clutter.vertices * mirror[None, None, :3]
    )
    for (height, ids), (mirror_height, mirror_ids), error in (
        (orthographic(clutter), orthographic(mirrored), 1e-6),
        (render_pinhole(clutter, CAMERA), render_pinhole(mirrored, CAMERA), 1e-5),
    ):
        agree = np.asarray(mirror_ids[::-1]) == ids
        assert agree.mean() >= 0.9999
        assert np.abs(np.asarray(mirror_height[::-1]) - height)[agree].max() < error


def test_permutation_of_hulls_changes_nothing(clutter):
    order = np.random.default_rng(2).permutation(31)
    permuted = jax.tree.map(lambda leaf: leaf[order], clutter)
    for view in (orthographic, functools.partial(pinhole, camera=CAMERA)):
        for expected, got in zip(view(clutter), view(permuted), strict=True):
            np.testing.assert_array_equal(got, expected)


def test_one_trace_and_batches_of_unequal_size(clutter):
    traces = []

    @jax.jit
    @jax.vmap
    def view(instances: HullInstances):
        traces.append(None)
        return heightmap.orthographic(instances)

    some = clutter.replace(present=jnp.arange(31) < 3)
    for pair in ((clutter, some), (some, some)):
        height, ids = view(jax.tree.map(lambda *leaves: jnp.stack(leaves), *pair))
        for i, single in enumerate(pair):
            np.testing.assert_allclose(height[i], orthographic(single)[0], atol=2e-6)
            np.testing.assert_array_equal(ids[i], orthographic(single)[1])
    assert len(traces) == 1


def look_at(position, target) -> Camera:
    """Return a camera at `position` that looks at `target`, image up = world up."""
    backward = np.subtract(position, target) / np.linalg.norm(np.subtract(position, target))
    right = np.cross([0, 0, 1], backward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(backward, right), backward], axis=1)
    position, rotation = jnp.asarray(position, jnp.float32), jnp.asarray(rotation, jnp.float32)
    return CAMERA.replace(position=position, rotation=rotation)


CAMERAS = [CAMERA, look_at((-0.5, -0.6, 0.7), (0, 0, 0.05)), look_at((0.1, -0.3, 0.4), (0, 0, 0.1))]


@pytest.mark.parametrize("camera", CAMERAS)
def test_pinhole_agrees_with_mujoco_rays(clutter, camera):
    """The third camera stands among hulls that reach behind it: what is behind is not drawn."""
    depth, labels = render_pinhole(clutter, camera)
    pixels = np.random.default_rng(3).choice(480 * 640, 20_000, replace=False)
    focal = 240 / np.tan(float(camera.fovy) / 2)
    row, col = pixels // 640, pixels % 640
    local = np.stack([(col + 0.5 - 320) / focal, (240 - row - 0.5) / focal, -np.ones(len(pixels))], axis=-1)
    directions = local @ np.asarray(camera.rotation, np.float64).T
    distance, expected = cast_rays(clutter, np.asarray(camera.position, np.float64), directions)
    with np.errstate(divide="ignore"):
        to_table = np.where(directions[:, 2] < 0, -float(camera.position[2]) / directions[:, 2], np.inf)
    hit = (distance > 0) & (distance < to_table)
    expected, distance = np.where(hit, expected, 0), np.where(hit, distance, to_table)
    depth, labels = np.asarray(depth).ravel()[pixels], np.asarray(labels).ravel()[pixels]
    assert (expected > 0).mean() > 0.2
    assert (labels == expected).mean() >= 0.999
    agree = (labels == expected) & np.isfinite(distance)
    assert np.abs(depth - distance)[agree].max() < 2e-5


def test_pinhole_heightmap_sees_tops_where_the_camera_does():
    """A tall box hides the far side of its shadow: there the table is reported, next to it a low box is seen."""
    # Walls stand inside cells: a point of a wall on the line between two cells belongs to either.
    tall = box_cloud((0.101, -0.049, 0), (0.139, 0.049, 0.28))
    hidden = box_cloud((0.151, -0.019, 0), (0.169, 0.019, 0.02))
    low = box_cloud((-0.149, -0.019, 0), (-0.101, 0.019, 0.05))
    instances = make_instances([tall, hidden, low], [1, 2, 3])
    height, ids = pinhole(instances, CAMERA)
    exact_height, exact_ids = orthographic(instances)
    assert (exact_ids == 2).sum() == 4 * 8 and not (ids == 2).any()
    assert not height[46:54, 79:84].any()
    for label in (1, 3):
        np.testing.assert_array_equal(ids == label, exact_ids == label)
        np.testing.assert_allclose(height[exact_ids == label], exact_height[exact_ids == label], atol=1e-5)


def test_unprojected_depth_lies_on_the_surface(clutter):
    camera = look_at((-0.5, -0.6, 0.7), (0, 0, 0.05))
    depth, labels = render_pinhole(clutter, camera)
    points = np.asarray(unproject(depth, camera))
    planes = np.asarray(clutter.planes, np.float64)
    for label in range(1, 10):
        sample = points[np.asarray(labels) == label][::37]
        for_label = planes[np.asarray(clutter.labels) == label]
        signed = np.einsum("kfi,pi->pkf", for_label[..., :3], sample) - for_label[:, None].swapaxes(0, 1)[..., 3]
        assert np.abs(signed.max(axis=-1)).min(axis=-1).max() < 2e-5
    table = points[np.asarray(labels) == 0]
    assert np.abs(table[:, 2]).max() < 1e-5


def test_shapes_are_asserted(clutter):
    with pytest.raises(AssertionError, match="one box and label per hull"):
        heightmap.orthographic(clutter.replace(labels=clutter.labels[:3]))
    with pytest.raises(AssertionError, match="tile 32 is larger"):
        heightmap.render_pinhole(clutter, CAMERA.replace(shape=(24, 640)))
