"""The MJCF, its link poses and hulls, the clearance and the closing region, each against an independent oracle."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import shapely
from scipy.spatial.transform import Rotation

from pregrasp_jax.assets.bank import ConvexObject, make_bank
from pregrasp_jax.robot import clearance, closing_region, description, links
from pregrasp_jax.robot import model as robot
from pregrasp_jax.robot.kinematics import hand_inverse_kinematics
from pregrasp_jax.types import CLOSED, FULL_TOPOLOGY, OPEN

RNG = np.random.default_rng(0)


@pytest.fixture
def data():
    return mujoco.MjData(description.robot_model())


def pose_robot(data, joint_pos):
    mj_model = description.robot_model()
    data.qpos[robot.joint_qpos_ids(mj_model)] = joint_pos
    data.joint("hand_left_tip").qpos[0], data.joint("hand_right_tip").qpos[0] = -joint_pos[6], -joint_pos[7]
    mujoco.mj_kinematics(mj_model, data)


# -- The model


def test_options_and_contact_settings_are_those_measured():
    mj_model = description.robot_model()
    assert mj_model.opt.timestep == 0.004 and mj_model.opt.impratio == 10 and mj_model.opt.iterations == 20
    assert mj_model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    assert mj_model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert mj_model.opt.ls_iterations == mujoco.MjOption().ls_iterations
    table = robot.load_table_spec().compile()
    for name in ("timestep", "impratio", "iterations", "cone", "integrator"):
        assert getattr(table.opt, name) == getattr(mj_model.opt, name)
    assert table.nbody == 1 and table.geom("table").friction[0] == 0.1
    np.testing.assert_allclose(robot.feed_forward(mj_model), [0.1, 0.1, 0.1, 0.05, 0.05, 0.05, 0])
    moving = mj_model.body_rootid == mj_model.body("base").id
    assert (mj_model.body_gravcomp[moving] == 1).all()


def test_every_robot_geom_is_a_capsule_or_a_box_and_collides_with_objects_only():
    mj_model = description.robot_model()
    for geom in links.link_geoms():
        i = mj_model.geom(geom.name).id
        assert int(mj_model.geom_type[i]) in (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_BOX)
        assert mj_model.geom_contype[i] & 1 == 0 and mj_model.geom_conaffinity[i] == 1
    assert mj_model.geom("table").conaffinity[0] == 3 and mj_model.geom("table").contype[0] == 0


def test_the_masses_are_the_makers():
    mj_model = description.robot_model()
    arm = [mj_model.body_mass[mj_model.joint(name).bodyid[0]] for name in robot.ARM_JOINTS]
    np.testing.assert_allclose(arm, [3.761, 8.058, 2.846, 1.37, 1.3, 0.365])
    hand = mj_model.body_subtreemass[mj_model.body("hand_palm").id]
    assert 0.72 <= hand <= 0.78


def test_table_friction_wins_over_an_objects():
    spec = robot.load_table_spec()
    body = spec.worldbody.add_body(pos=[0, 0, 0.05])
    body.add_freejoint()
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.05] * 3, friction=[0.9, 0, 0])
    mj_model = spec.compile()
    data = mujoco.MjData(mj_model)
    mujoco.mj_step(mj_model, data, 10)
    assert data.ncon == 4 and (data.contact.friction[:, 0] == 0.1).all()


def test_home_is_the_start_pose_open_and_at_rest(data):
    mj_model = description.robot_model()
    robot.set_home(mj_model, data)
    np.testing.assert_allclose(data.site("grasp_point").xpos, robot.START_POSE[:3], atol=1e-5)
    np.testing.assert_allclose(data.site("grasp_point").xmat, np.eye(3).ravel(), atol=1e-5)
    before = data.qpos.copy()
    mujoco.mj_step(mj_model, data, 250)
    assert np.abs(data.qpos - before).max() < 1e-3
    np.testing.assert_allclose(robot.home_joint_pos()[6:], [robot.FINGER_OPEN] * 2)


def test_the_aperture_follows_the_makers_formula_and_changes_within_half_a_second(data):
    mj_model = description.robot_model()
    pads = [mj_model.geom(f"hand_{side}_pad").id for side in ("left", "right")]
    gap = np.nan
    for angle in (0.0, 0.3, 0.9, 1.223):
        pose_robot(data, np.append(robot.home_joint_pos()[:6], [angle, angle]))
        gap = abs(np.diff(data.geom_xpos[pads, 1]))[0] - 2 * mj_model.geom_size[pads[0], 1]
        assert gap == pytest.approx(2 * (0.0549 * np.sin(angle) + 0.0025 * (1 - np.cos(angle))), abs=1e-5)
    assert gap == pytest.approx(0.1066, abs=3e-4)
    tip = [np.max(data.geom_xpos[pads, 0]) + mj_model.geom_size[pads[0], 0]]
    pose_robot(data, np.append(robot.home_joint_pos()[:6], [0.0, 0.0]))
    tip.append(np.max(data.geom_xpos[pads, 0]) + mj_model.geom_size[pads[0], 0])
    assert tip[1] - tip[0] == pytest.approx(0.034, abs=3e-4)  # the tips come back by this much when open
    assert tip[1] - robot.START_POSE[0] + robot.GRASP_OFFSET == pytest.approx(0.231, abs=1e-4)
    robot.set_home(mj_model, data)
    for command in (robot.FINGER_CLOSED, robot.FINGER_OPEN):
        data.ctrl[-1] = command
        mujoco.mj_step(mj_model, data, 125)
        joints = data.qpos[robot.joint_qpos_ids(mj_model)[6:]]
        np.testing.assert_allclose(joints, command, atol=0.01)
        np.testing.assert_allclose(data.joint("hand_left_tip").qpos[0], -joints[0], atol=2e-3)


def test_the_overhead_camera_sees_the_whole_workspace():
    mj_model = description.robot_model()
    camera = mj_model.camera("overhead")
    half_angle = np.deg2rad(camera.fovy[0]) / 2
    highest = 0.30  # m, where heightmaps end
    assert 0.25 < (camera.pos[2] - highest) * np.tan(half_angle) < 0.28
    assert mj_model.cam_resolution[camera.id].tolist() == [640, 480]


def test_no_posture_of_the_start_branch_lets_the_arm_touch_itself_or_the_table(data):
    """Self-collision is off in the MJCF because no push can reach it; this is the proof."""
    mj_model = description.robot_model()
    x, y = np.meshgrid(np.linspace(-0.3, 0.25, 5), np.linspace(-0.25, 0.25, 5))
    hand = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.1), np.tile([1, 0, 0, 0], (x.size, 1))])
    hand = np.concatenate([[robot.START_POSE], hand]).astype(np.float32)
    solutions = np.asarray(jax.jit(jax.vmap(hand_inverse_kinematics))(hand))
    branch = int(np.nanargmin(np.abs(solutions[0] - robot.home_joint_pos()[:6]).max(axis=1)))
    chain = links.links()
    pairs = [
        (a.name, b.name)
        for i, a in enumerate(links.link_geoms())
        for b in links.link_geoms()[i + 1 :]
        if a.link != b.link
        and chain[b.link].parent != a.link
        and not chain[a.link].name.startswith(("wrist_3", "hand"))
    ]
    assert ("base", "upper_arm") in pairs and ("upper_arm", "wrist_2") in pairs
    for arm in solutions[:, branch]:
        pose_robot(data, np.append(arm, [robot.FINGER_OPEN] * 2))
        for a, b in pairs:
            ids = mj_model.geom(a).id, mj_model.geom(b).id
            assert mujoco.mj_geomDistance(mj_model, data, *ids, 0.01, None) > 0.002, (a, b)
    assert (
        np.asarray(jax.jit(jax.vmap(clearance.link_clearance))(solutions[:, branch])).min() > clearance.CLEARANCE_MARGIN
    )


# -- Links


def test_link_poses_are_mujocos(data):
    joint_pos = RNG.uniform(-3, 3, (50, 8)).astype(np.float32)
    poses = np.asarray(jax.jit(jax.vmap(links.link_poses))(joint_pos))
    for row, found in zip(joint_pos, poses, strict=True):
        pose_robot(data, row)
        for link, pose in zip(links.links(), found, strict=True):
            body = data.body(link.name)
            np.testing.assert_allclose(pose[:3], body.xpos, atol=1e-6)
            np.testing.assert_allclose(pose[3:] * np.sign(pose[3:] @ body.xquat), body.xquat, atol=1e-6)


def test_hulls_are_the_geoms(data):
    """Support function of every hull, at its link's pose, against the geom's own in MuJoCo's world frame."""
    mj_model = description.robot_model()
    hulls, link_index = links.robot_hulls()
    assert hulls.vertices.shape[1:] == (FULL_TOPOLOGY[0], 3) and hulls.planes.shape[1:] == (FULL_TOPOLOGY[1], 4)
    joint_pos = RNG.uniform(-2, 2, 8).astype(np.float32)
    pose_robot(data, joint_pos)
    matrices = np.asarray(links.link_matrices(jnp.asarray(joint_pos)))
    directions = RNG.normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    assert len(link_index) == sum(mj_model.geom_bodyid > 0)
    for k, geom in enumerate(links.link_geoms()):
        matrix = matrices[link_index[k]]
        world = np.asarray(hulls.vertices[k]) @ matrix[:3, :3].T + matrix[:3, 3]
        i = mj_model.geom(geom.name).id
        local = directions @ data.geom_xmat[i].reshape(3, 3)
        size = mj_model.geom_size[i]
        if mj_model.geom_type[i] == mujoco.mjtGeom.mjGEOM_BOX:
            extent, tolerance = np.abs(local) @ size, 1e-5
        else:
            extent, tolerance = np.abs(local[:, 2]) * size[1] + size[0], links.CAPSULE_ERROR * size[0] + 1e-5
        wanted = directions @ data.geom_xpos[i] + extent
        np.testing.assert_allclose((world @ directions.T).max(axis=0), wanted, atol=tolerance)
        inside = np.asarray(hulls.vertices[k]) @ np.asarray(hulls.planes[k, :, :3]).T - np.asarray(
            hulls.planes[k, :, 3]
        )
        assert inside.max() < 1e-6


# -- Clearance


def test_clearance_is_mujocos_distance(data):
    mj_model = description.robot_model()
    joints = RNG.uniform(-3, 3, (60, 6)).astype(np.float32)
    found = np.asarray(jax.jit(jax.vmap(clearance.link_clearance))(joints))
    names = [
        g.name for g in links.link_geoms() if "driver" not in g.name and "tip" not in g.name and "pad" not in g.name
    ]
    names.remove("base")
    table = mj_model.geom("table").id
    for row, distance in zip(joints, found, strict=True):
        pose_robot(data, np.append(row, [0, 0]))
        wanted = min(mujoco.mj_geomDistance(mj_model, data, table, mj_model.geom(n).id, 3.0, None) for n in names)
        # MuJoCo's distance of penetrating geoms is a depth along the plane's normal too, capped by its own routine.
        if wanted > 0:
            assert distance == pytest.approx(wanted, abs=1e-5)
        else:
            assert distance <= 1e-5
    assert (found > 0).any() and (found < 0).any()


def test_clearance_of_a_wall_by_hand():
    # The hand's body is 32 mm to each side of y = 0 at the start and is the only part beyond x = -0.5.
    joints = jnp.asarray(robot.home_joint_pos()[:6])
    ahead = np.array([[-1.0, 0.0, 0.0, 0.30]], np.float32)  # free where x <= -0.30
    palm = robot.START_POSE[0] - robot.GRASP_OFFSET + 0.1456
    assert float(clearance.link_clearance(joints, planes=ahead)) == pytest.approx(-0.30 - palm, abs=1e-5)
    both = np.concatenate([ahead, clearance.TABLE_PLANE])
    assert float(clearance.link_clearance(joints, planes=both)) == pytest.approx(
        min(-0.30 - palm, float(clearance.link_clearance(joints))), abs=1e-6
    )


# -- Closing region


@pytest.fixture(scope="module")
def bank():
    """A 40 x 40 mm box, then objects of 1 to 6 random hulls, some of them apart from each other."""
    corners = np.array([[x, y, z] for x in (-0.02, 0.02) for y in (-0.02, 0.02) for z in (0, 0.15)])

    rng = np.random.default_rng(1)

    def part():
        return rng.normal(size=(24, 3)) * rng.uniform(0.008, 0.03, 3) + rng.uniform(-0.03, 0.03, 3) + [0, 0, 0.1]

    random = [ConvexObject(f"random_{i}", [part() for _ in range(i)]) for i in range(1, 7)]
    return make_bank([ConvexObject("box", [corners]), *random])


def shapely_coverage(bank, object_id, pose, hand_pose):
    low, high = closing_region.closing_region_bounds()
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
    low, high = closing_region.closing_region_bounds()
    np.testing.assert_allclose(low, [0.1456 - 0.172, -0.055], atol=1e-9)
    np.testing.assert_allclose(high, [0.2311 - 0.172, 0.055], atol=1e-9)


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
        found.append(np.asarray(scene_coverage(bank, ids, poses, hand, OPEN)))
        wanted.append([shapely_coverage(bank, i, p, hand) for i, p in zip(ids, poses, strict=True)])
    found, wanted = np.concatenate(found), np.concatenate(wanted)
    np.testing.assert_allclose(found, wanted, atol=0.004)
    assert (wanted == 0).any() and (wanted > 0.9).any() and ((wanted > 0.2) & (wanted < 0.8)).any()


def test_coverage_by_hand(bank):
    """A 40 x 40 mm box: whole, cut by the palm, cut by the side, outside; closed hand and empty slots give 0."""
    low, high = closing_region.closing_region_bounds()
    centres = [[0.01, 0], [low[0], 0], [0.0, high[1] - 0.01], [high[0] + 0.03, 0], [0.01, 0]]
    wanted = [1.0, 0.5, 0.75, 0.0, 0.0]
    poses = np.zeros((8, 7), np.float32)
    poses[:, 3] = 1
    poses[:5, :2] = centres
    poses[:, 0] += 0.1
    ids = np.array([0, 0, 0, 0, -1, -1, -1, -1], np.int32)
    hand = np.array([0.1, 0, 0.1, 1, 0, 0, 0], np.float32)
    found = np.asarray(scene_coverage(bank, ids, poses, hand, OPEN))
    np.testing.assert_allclose(found[:5], wanted, atol=1e-3)
    assert found[0] == pytest.approx(1.0, abs=1e-6) and (found[4:] == 0).all()
    assert (np.asarray(scene_coverage(bank, ids, poses, hand, CLOSED)) == 0).all()


def test_union_counts_overlap_once():
    # Two equal intervals, one inside them, one touching, one apart, one empty.
    bottom = jnp.array([0.0, 0.0, 0.25, 1.0, 3.0, 5.0])[:, None]
    top = jnp.array([1.0, 1.0, 0.5, 2.0, 3.5, 4.0])[:, None]
    assert float(closing_region._union_length(bottom, top)[0]) == pytest.approx(2.5)
    order = np.random.default_rng(3).permutation(6)
    assert float(closing_region._union_length(bottom[order], top[order])[0]) == pytest.approx(2.5)
