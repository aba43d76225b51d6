import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from heightmap_oracle import box_cloud, cast_rays, hull_planes, make_instances, pad, random_clouds

from pregrasp_jax import heightmap
from pregrasp_jax.geometry import transform_points
from pregrasp_jax.robot import description, get_robot
from pregrasp_jax.robot.base import hand_pose_of
from pregrasp_jax.robot.ur5e_rg2 import FINGER_OPEN
from pregrasp_jax.scene.spec import table_model
from pregrasp_jax.spaces import grid
from pregrasp_jax.spaces.workspace import TABLE, Box, Workspace
from pregrasp_jax.types import (
    FULL_TOPOLOGY,
    MAX_HULLS,
    MAX_OBJECTS,
    ROBOT_ID,
    HandPose,
    HullBank,
    Hulls,
    Observation,
    PhysicsObservation,
    SceneParams,
)

ROBOT = get_robot("ur5e_rg2")


def hand_at(x: float, y: float) -> HandPose:
    return hand_pose_of((x, y), z=0.1, yaw=0.0, aperture=FINGER_OPEN)


@pytest.fixture(scope="module")
def joints() -> jax.Array:
    """An open hand in the middle of the workspace, 5 cm off the axis; one finger is less open than the other."""
    hand_pose = jnp.array([0.05, -0.05, 0.1, 1.0, 0.0, 0.0, 0.0])
    still, fingers = jnp.stack([hand_pose] * 2), jnp.full(2, FINGER_OPEN)
    follow = jax.jit(ROBOT.follow, static_argnums=3)
    controls, _ = follow(jnp.asarray(ROBOT.home), still, fingers, TABLE)
    return jnp.append(controls[0, :6], jnp.array([FINGER_OPEN, 0.6 * FINGER_OPEN]))


@pytest.fixture(scope="module")
def bank() -> HullBank:
    """Three objects of 1, 6 and 2 random hulls; only the arrays that drawing reads are filled."""
    rng = np.random.default_rng(0)
    counts = (1, MAX_HULLS, 2)
    clouds = random_clouds(rng, sum(counts), spread=0.05)
    full = Hulls(
        vertices=jnp.asarray(np.stack([pad(c, FULL_TOPOLOGY[0]) for c in clouds]), jnp.float32),
        planes=jnp.asarray(np.stack([pad(hull_planes(c), FULL_TOPOLOGY[1]) for c in clouds]), jnp.float32),
        edges=jnp.zeros((len(clouds), FULL_TOPOLOGY[2], 2), jnp.int32),
    )
    hulls, start = -np.ones((3, MAX_HULLS), np.int32), 0
    for i, count in enumerate(counts):
        hulls[i, :count] = np.arange(start, start + count)
        start += count
    rest = {name: jnp.zeros(3) for name in ("mass", "com", "inertia", "inertia_quat", "friction", "height")}
    rest["min_width"] = jnp.zeros(3)
    return HullBank(
        full=full, coarse=full, object_hulls=jnp.asarray(hulls), names=("a", "b", "c"), content_hash="", **rest
    )


def make_scene(key: jax.Array, object_ids: list[int], joints: jax.Array) -> tuple[SceneParams, PhysicsObservation]:
    place, turn = jax.random.split(key)
    quat = jax.random.normal(turn, (MAX_OBJECTS, 4))
    pos = jax.random.uniform(place, (MAX_OBJECTS, 3), minval=-0.2, maxval=0.2) * jnp.array([[1.0, 1.0, 0.2]])
    poses = jnp.concatenate([pos, quat / jnp.linalg.norm(quat, axis=1, keepdims=True)], axis=1)
    # The scene's own poses are decoys: what is drawn is where the physics has put the objects.
    scene = SceneParams(object_ids=jnp.array(object_ids), poses=poses[::-1] + 1.0, target=jnp.int32(0))
    hand = jnp.array([0.0, 0.0, 0.1, 1.0, 0.0, 0.0, 0.0])
    nothing = {"diverged": jnp.bool(False), "overflows": jnp.int32(0)}
    return scene, PhysicsObservation(object_poses=poses, joint_pos=joints, hand_pose=hand, **nothing)


def test_scene_hulls_agree_with_mujoco_rays(bank, joints, key):
    scene, physics_obs = make_scene(key, [2, -1, 1, 0, 2, -1, 1, -1], joints)
    hulls = jax.jit(functools.partial(heightmap.scene_hulls, bank, ROBOT))(scene, physics_obs)
    num_objects = MAX_OBJECTS * MAX_HULLS
    assert [int(n) for n in hulls.present[:num_objects].reshape(MAX_OBJECTS, -1).sum(axis=1)] == [
        2,
        0,
        6,
        1,
        2,
        0,
        6,
        0,
    ]
    # Oracle: place the bank's own vertices one by one; hulls and rays are MuJoCo's.
    clouds, labels = [], []
    for slot, object_id in enumerate(scene.object_ids.tolist()):
        for hull in bank.object_hulls[object_id].tolist() if object_id >= 0 else []:
            if hull >= 0:
                clouds.append(np.asarray(transform_points(physics_obs.object_poses[slot], bank.full.vertices[hull])))
                labels.append(slot + 1)
    for vertices in hulls.vertices[num_objects:]:
        clouds.append(np.asarray(vertices))
        labels.append(ROBOT_ID)
    centers = np.asarray(grid.cell_centers(), np.float64)
    x, y = np.meshgrid(centers, centers)
    origins = np.stack([x.ravel(), y.ravel(), np.full(x.size, 2.0)], axis=-1)
    distance, expected = cast_rays(make_instances(clouds, labels), origins, np.tile([0.0, 0.0, -1.0], (x.size, 1)))
    seen = (distance >= 0) & (distance < 2)
    height, ids = heightmap.orthographic(hulls)
    agree = np.asarray(ids).ravel() == np.where(seen, expected, 0)
    assert agree.mean() >= 0.999
    assert set(np.unique(ids)) >= {0, 1, 3, 5, 7, ROBOT_ID}
    assert np.abs(np.asarray(height).ravel() - np.where(seen, 2 - distance, 0))[agree].max() < 5e-6


def test_robot_is_drawn_where_mujoco_has_it(joints):
    """Against the MJCF's own capsules and boxes, not their polyhedra: outlines differ by the capsule error."""
    mj_model = description.robot_model()
    mj_data = mujoco.MjData(mj_model)
    mj_data.qpos[ROBOT.joint_qpos_ids(mj_model)] = joints
    # The tips follow the drivers; without a step their mimic joints are set by hand.
    for equality in range(mj_model.neq):
        follower, leader = mj_model.eq_obj1id[equality], mj_model.eq_obj2id[equality]
        ratio = mj_model.eq_data[equality, 1]
        mj_data.qpos[mj_model.jnt_qposadr[follower]] = ratio * mj_data.qpos[mj_model.jnt_qposadr[leader]]
    mujoco.mj_forward(mj_model, mj_data)
    height, ids = jax.jit(lambda x: heightmap.orthographic(heightmap.robot_hulls(ROBOT, x)))(joints)
    expected, geom_id = np.zeros((100, 100)), np.zeros(1, np.int32)
    for row, y in enumerate(grid.cell_centers().tolist()):
        for col, x in enumerate(grid.cell_centers().tolist()):
            distance = mujoco.mj_ray(mj_model, mj_data, [x, y, 2.0], [0, 0, -1], None, 1, -1, geom_id)
            expected[row, col] = 2 - distance if distance >= 0 else 0
    drawn = expected > 1e-3
    assert 0.05 < drawn.mean() < 0.9
    assert ((np.asarray(ids) == ROBOT_ID) == drawn).mean() > 0.97
    both = (np.asarray(ids) == ROBOT_ID) & drawn
    assert np.median(np.abs(np.asarray(height) - expected)[both]) < 0.004


def test_observe_quantizes_and_refuses_unknown_cameras(bank, key):
    # No side lies along a row of rays: which cells it has would depend on how a program rounds.
    boxes = [box_cloud((0.0513, 0.0517, 0), (0.1113, 0.1117, 0.06)), box_cloud((0.001, 0.001, 0.4), (0.04, 0.04, 0.5))]
    hulls, hand = make_instances(boxes, [1, 2]), hand_at(-0.1, 0.02)
    obs = jax.jit(heightmap.observe)(hulls, hand)
    jax.tree.map(np.testing.assert_array_equal, obs.hand, hand)
    assert obs.height.dtype == obs.instance_ids.dtype == jnp.uint8
    assert obs.height[65, 65] == 51 and obs.instance_ids[65, 65] == 1  # 0.06 m of 0.30 m in 255 steps
    assert obs.height[54, 54] == 255 and obs.instance_ids[54, 54] == 2
    through_pinhole = jax.jit(functools.partial(heightmap.observe, camera="pinhole"))(hulls, hand)
    # A surface at 0.5 m seen from 1 m stays over its own cells: its points are unprojected with their depth.
    np.testing.assert_array_equal(through_pinhole.instance_ids[66:71, 66:71], 1)
    np.testing.assert_array_equal(through_pinhole.instance_ids[51:57, 51:57], 2)
    same = jax.jit(lambda h, camera: heightmap.observe(h, hand, camera=camera))(hulls, heightmap.overhead_camera())
    np.testing.assert_array_equal(same.height, through_pinhole.height)
    with pytest.raises(ValueError, match="camera 'fisheye' is unknown; allowed are orthographic, pinhole"):
        heightmap.observe(hulls, hand, camera="fisheye")


def test_overhead_camera_is_the_one_of_the_mjcf():
    camera = heightmap.overhead_camera()
    assert camera.shape == (480, 640)
    np.testing.assert_allclose(camera.rotation, np.eye(3), atol=1e-6)
    # A point is where MuJoCo's own camera frame puts it: +x right, +y up, row 0 on top.
    point = make_instances([box_cloud((0.10, 0.15, 0), (0.102, 0.152, 0.001))], [1])
    _, labels = jax.jit(heightmap.render_pinhole)(point, camera)
    rows, columns = np.nonzero(labels)
    focal = 240 / np.tan(np.deg2rad(table_model().camera("overhead").fovy.item()) / 2)
    np.testing.assert_allclose(columns.mean() + 0.5, 320 + focal * 0.101, atol=0.5)
    np.testing.assert_allclose(rows.mean() + 0.5, 240 - focal * 0.151, atol=0.5)


def test_fused_segmentation_by_hand():
    ids = jnp.array([[0, 1, 2], [8, 9, 3]], jnp.uint8)
    np.testing.assert_array_equal(heightmap.fuse_segmentation(ids, jnp.int32(2)), [[0, 1, 1], [1, 3, 2]])
    np.testing.assert_array_equal(heightmap.fuse_segmentation(ids, jnp.int32(0)), [[0, 2, 1], [1, 3, 1]])
    np.testing.assert_array_equal(heightmap.fuse_segmentation(ids, jnp.int32(7)), [[0, 1, 1], [2, 3, 1]])


def test_network_input_by_hand():
    # Heights 0, 0, 0, 0.30 m: mean 0.075, standard deviation (of the population) 0.1299.
    obs = Observation(
        jnp.array([[0, 0], [0, 255]], jnp.uint8), jnp.array([[0, 9], [1, 2]], jnp.uint8), hand_at(0.0, 0.0)
    )
    image = heightmap.network_input(obs, jnp.int32(1))
    np.testing.assert_allclose(image[..., 0], [[-0.57735, -0.57735], [-0.57735, 1.73205]], atol=1e-4)
    np.testing.assert_allclose(image[..., 1], [[0, 1], [1 / 3, 2 / 3]], atol=1e-6)
    flat = Observation(jnp.full((4, 4), 100, jnp.uint8), jnp.zeros((4, 4), jnp.uint8), hand_at(0.0, 0.0))
    np.testing.assert_allclose(heightmap.network_input(flat, jnp.int32(0)), 0.0, atol=1e-4)
    # Below the floor of 1 mm: one quantum of 1.18 mm in one of 16 cells has a deviation of 0.28 mm.
    bump = heightmap.network_input(flat.replace(height=flat.height.at[0, 0].add(1)), jnp.int32(0))
    np.testing.assert_allclose(bump[0, 0, 0], 15 / 16 * 0.30 / 255 / 1e-3, rtol=1e-3)


def test_walls_are_as_high_as_they_are_and_belong_to_the_table(bank, joints, key):
    """A wall inside the grid hides what is behind it; its pixels have the id of the table, as if it grew out of it."""
    workspace = Workspace(
        name="room",
        walls=(
            Box(center=(0.2, 0.0, 0.06), half_size=(0.02, 0.1, 0.06), yaw=np.pi / 2),
            Box(center=(0.0, 0.8, 0.1), half_size=(0.5, 0.02, 0.1)),
        ),
    )
    scene, physics_obs = make_scene(key, [-1] * MAX_OBJECTS, joints)
    hulls_of = jax.jit(functools.partial(heightmap.scene_hulls, bank, ROBOT), static_argnums=2)
    walled, plain = hulls_of(scene, physics_obs, workspace), hulls_of(scene, physics_obs)
    assert walled.present.shape[0] == plain.present.shape[0] + 2
    height, ids = heightmap.orthographic(walled)
    bare_height, bare_ids = heightmap.orthographic(plain)
    centers = grid.cell_centers()
    y, x = np.meshgrid(centers, centers, indexing="ij")
    inside = (np.abs(x - 0.2) < 0.1) & (np.abs(y) < 0.02)  # turned by a right angle
    bare = inside & (np.asarray(bare_ids) == 0)
    assert bare.sum() > 100
    np.testing.assert_array_equal(np.asarray(ids)[bare], 0)
    np.testing.assert_allclose(np.asarray(height)[bare], 0.12, atol=1e-6)
    np.testing.assert_array_equal(np.asarray(ids)[~inside], np.asarray(bare_ids)[~inside])
    np.testing.assert_array_equal(np.asarray(height)[~inside], np.asarray(bare_height)[~inside])
