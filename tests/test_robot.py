"""The MJCF, its link poses and hulls, the clearance and the closing region, each against an independent oracle."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from pregrasp_jax.robot import clearance, description, get_robot
from pregrasp_jax.robot.kinematics import hand_inverse_kinematics
from pregrasp_jax.robot.links import CAPSULE_ERROR
from pregrasp_jax.robot.ur5e_rg2 import FINGER_CLOSED, FINGER_OPEN, moving
from pregrasp_jax.scene.spec import compile_spec, scene_spec, table_spec
from pregrasp_jax.spaces.workspace import TABLE, Box, Workspace
from pregrasp_jax.types import FULL_TOPOLOGY

ROBOT = get_robot("ur5e_rg2")
LINKS = ROBOT.links
START_POSE = np.array([-0.30, 0.0, 0.1, 1.0, 0.0, 0.0, 0.0])
GRASP_OFFSET = 0.172
"""m, from the flange to the grasp point along the hand."""

RNG = np.random.default_rng(0)


@functools.cache
def scene_model():
    return compile_spec(scene_spec(ROBOT, TABLE))


@pytest.fixture
def data():
    return mujoco.MjData(scene_model())


def pose_robot(data, joint_pos):
    mj_model = scene_model()
    data.qpos[ROBOT.joint_qpos_ids(mj_model)] = joint_pos
    data.joint("hand_left_tip").qpos[0], data.joint("hand_right_tip").qpos[0] = -joint_pos[6], -joint_pos[7]
    mujoco.mj_kinematics(mj_model, data)


clearances = jax.jit(jax.vmap(lambda joint_pos: ROBOT.clearance(joint_pos, TABLE)))


# -- The model


def test_options_and_contact_settings_are_those_measured():
    mj_model = scene_model()
    assert mj_model.opt.timestep == 0.004 and mj_model.opt.impratio == 10 and mj_model.opt.iterations == 20
    assert mj_model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    assert mj_model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert mj_model.opt.ls_iterations == mujoco.MjOption().ls_iterations
    table = table_spec(TABLE).compile()
    for name in ("timestep", "impratio", "iterations", "cone", "integrator"):
        assert getattr(table.opt, name) == getattr(mj_model.opt, name)
    assert table.nbody == 1 and table.geom("table").friction[0] == 0.1
    np.testing.assert_allclose(description.feed_forward(), [0.1, 0.1, 0.1, 0.05, 0.05, 0.05, 0])
    moving = mj_model.body_rootid == mj_model.body("base").id
    assert (mj_model.body_gravcomp[moving] == 1).all()


def test_every_robot_geom_is_a_capsule_or_a_box_and_collides_with_objects_only():
    mj_model = scene_model()
    for geom in LINKS.geoms:
        i = mj_model.geom(geom.name).id
        assert int(mj_model.geom_type[i]) in (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_BOX)
        assert mj_model.geom_contype[i] & 1 == 0 and mj_model.geom_conaffinity[i] == 1
    assert mj_model.geom("table").conaffinity[0] == 3 and mj_model.geom("table").contype[0] == 0


def test_the_masses_are_the_makers():
    mj_model = scene_model()
    arm = [mj_model.body_mass[mj_model.joint(name).bodyid[0]] for name in description.ARM_JOINTS]
    np.testing.assert_allclose(arm, [3.761, 8.058, 2.846, 1.37, 1.3, 0.365])
    hand = mj_model.body_subtreemass[mj_model.body("hand_palm").id]
    assert 0.72 <= hand <= 0.78


def test_table_friction_wins_over_an_objects():
    spec = table_spec(TABLE)
    body = spec.worldbody.add_body(pos=[0, 0, 0.05])
    body.add_freejoint()
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.05] * 3, friction=[0.9, 0, 0])
    mj_model = spec.compile()
    data = mujoco.MjData(mj_model)
    mujoco.mj_step(mj_model, data, 10)
    assert data.ncon == 4 and (data.contact.friction[:, 0] == 0.1).all()


def test_home_is_the_start_pose_open_and_at_rest(data):
    mj_model = scene_model()
    ROBOT.set_home(mj_model, data)
    np.testing.assert_allclose(data.site("grasp_point").xpos, START_POSE[:3], atol=1e-5)
    np.testing.assert_allclose(data.site("grasp_point").xmat, np.eye(3).ravel(), atol=1e-5)
    before = data.qpos.copy()
    mujoco.mj_step(mj_model, data, 250)
    assert np.abs(data.qpos - before).max() < 1e-3
    np.testing.assert_allclose(ROBOT.home[6:], [FINGER_OPEN] * 2)


def test_the_aperture_follows_the_makers_formula_and_changes_within_half_a_second(data):
    mj_model = scene_model()
    pads = [mj_model.geom(f"hand_{side}_pad").id for side in ("left", "right")]
    gap = np.nan
    for angle in (0.0, 0.3, 0.9, 1.223):
        pose_robot(data, np.append(ROBOT.home[:6], [angle, angle]))
        gap = abs(np.diff(data.geom_xpos[pads, 1]))[0] - 2 * mj_model.geom_size[pads[0], 1]
        assert gap == pytest.approx(2 * (0.0549 * np.sin(angle) + 0.0025 * (1 - np.cos(angle))), abs=1e-5)
    assert gap == pytest.approx(0.1066, abs=3e-4)
    tip = [np.max(data.geom_xpos[pads, 0]) + mj_model.geom_size[pads[0], 0]]
    pose_robot(data, np.append(ROBOT.home[:6], [0.0, 0.0]))
    tip.append(np.max(data.geom_xpos[pads, 0]) + mj_model.geom_size[pads[0], 0])
    assert tip[1] - tip[0] == pytest.approx(0.034, abs=3e-4)  # the tips come back by this much when open
    assert tip[1] - START_POSE[0] + GRASP_OFFSET == pytest.approx(0.231, abs=1e-4)
    ROBOT.set_home(mj_model, data)
    for command in (FINGER_CLOSED, FINGER_OPEN):
        data.ctrl[-1] = command
        mujoco.mj_step(mj_model, data, 125)
        joints = data.qpos[ROBOT.joint_qpos_ids(mj_model)[6:]]
        np.testing.assert_allclose(joints, command, atol=0.01)
        np.testing.assert_allclose(data.joint("hand_left_tip").qpos[0], -joints[0], atol=2e-3)


def test_the_overhead_camera_sees_the_whole_workspace():
    mj_model = scene_model()
    camera = mj_model.camera("overhead")
    half_angle = np.deg2rad(camera.fovy[0]) / 2
    highest = 0.30  # m, where heightmaps end
    assert 0.25 < (camera.pos[2] - highest) * np.tan(half_angle) < 0.28
    assert mj_model.cam_resolution[camera.id].tolist() == [640, 480]


def test_no_posture_of_the_start_branch_lets_the_arm_touch_itself_or_the_table(data):
    """Self-collision is off in the MJCF because no push can reach it; this is the proof."""
    mj_model = scene_model()
    x, y = np.meshgrid(np.linspace(-0.3, 0.25, 5), np.linspace(-0.25, 0.25, 5))
    hand = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.1), np.tile([1, 0, 0, 0], (x.size, 1))])
    hand = np.concatenate([[START_POSE], hand]).astype(np.float32)
    solutions = np.asarray(jax.jit(jax.vmap(functools.partial(hand_inverse_kinematics, description.arm())))(hand))
    branch = int(np.nanargmin(np.abs(solutions[0] - ROBOT.home[:6]).max(axis=1)))
    pairs = [
        (a.name, b.name)
        for i, a in enumerate(LINKS.geoms)
        for b in LINKS.geoms[i + 1 :]
        if a.link != b.link
        and LINKS.parents[b.link] != a.link
        and not LINKS.names[a.link].startswith(("wrist_3", "hand"))
    ]
    assert ("base", "upper_arm") in pairs and ("upper_arm", "wrist_2") in pairs
    for arm in solutions[:, branch]:
        pose_robot(data, np.append(arm, [FINGER_OPEN] * 2))
        for a, b in pairs:
            ids = mj_model.geom(a).id, mj_model.geom(b).id
            assert mujoco.mj_geomDistance(mj_model, data, *ids, 0.01, None) > 0.002, (a, b)
    joints = np.insert(solutions[:, branch], 6, FINGER_OPEN, axis=1)
    joints = np.insert(joints, 7, FINGER_OPEN, axis=1)
    assert np.asarray(clearances(joints)).min() > clearance.CLEARANCE_MARGIN


# -- Links


def test_link_poses_are_mujocos(data):
    joint_pos = RNG.uniform(-3, 3, (50, 8)).astype(np.float32)
    poses = np.asarray(jax.jit(jax.vmap(LINKS.poses))(joint_pos))
    for row, found in zip(joint_pos, poses, strict=True):
        pose_robot(data, row)
        for link, pose in zip(LINKS.names, found, strict=True):
            body = data.body(link)
            np.testing.assert_allclose(pose[:3], body.xpos, atol=1e-6)
            np.testing.assert_allclose(pose[3:] * np.sign(pose[3:] @ body.xquat), body.xquat, atol=1e-6)


def test_hulls_are_the_geoms(data):
    """Support function of every hull, at its link's pose, against the geom's own in MuJoCo's world frame."""
    mj_model = scene_model()
    hulls, link_index = LINKS.hulls, LINKS.hull_links
    assert hulls.vertices.shape[1:] == (FULL_TOPOLOGY[0], 3) and hulls.planes.shape[1:] == (FULL_TOPOLOGY[1], 4)
    joint_pos = RNG.uniform(-2, 2, 8).astype(np.float32)
    pose_robot(data, joint_pos)
    matrices = np.asarray(LINKS.matrices(jnp.asarray(joint_pos)))
    directions = RNG.normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    assert len(link_index) == sum(mj_model.geom_bodyid > 0)
    for k, geom in enumerate(LINKS.geoms):
        matrix = matrices[link_index[k]]
        world = np.asarray(hulls.vertices[k]) @ matrix[:3, :3].T + matrix[:3, 3]
        i = mj_model.geom(geom.name).id
        local = directions @ data.geom_xmat[i].reshape(3, 3)
        size = mj_model.geom_size[i]
        if mj_model.geom_type[i] == mujoco.mjtGeom.mjGEOM_BOX:
            extent, tolerance = np.abs(local) @ size, 1e-5
        else:
            extent, tolerance = np.abs(local[:, 2]) * size[1] + size[0], CAPSULE_ERROR * size[0] + 1e-5
        wanted = directions @ data.geom_xpos[i] + extent
        np.testing.assert_allclose((world @ directions.T).max(axis=0), wanted, atol=tolerance)
        inside = np.asarray(hulls.vertices[k]) @ np.asarray(hulls.planes[k, :, :3]).T - np.asarray(
            hulls.planes[k, :, 3]
        )
        assert inside.max() < 1e-6


# -- Clearance


def test_clearance_is_mujocos_distance(data):
    mj_model = scene_model()
    joints = RNG.uniform(-3, 3, (60, 8)).astype(np.float32)
    found = np.asarray(clearances(joints))
    names = [g.name for g in LINKS.geoms if "driver" not in g.name and "tip" not in g.name and "pad" not in g.name]
    names.remove("base")
    table = mj_model.geom("table").id
    for row, distance in zip(joints, found, strict=True):
        pose_robot(data, row)
        wanted = min(mujoco.mj_geomDistance(mj_model, data, table, mj_model.geom(n).id, 3.0, None) for n in names)
        # MuJoCo's distance of penetrating geoms is a depth along the plane's normal too, capped by its own routine.
        if wanted > 0:
            assert distance == pytest.approx(wanted, abs=1e-5)
        else:
            assert distance <= 1e-5
    assert (found > 0).any() and (found < 0).any()


def walled(*walls: Box) -> Workspace:
    return Workspace(name="walled", walls=walls)


def test_clearance_of_a_wall_by_hand():
    """The tips of the closed fingers end 231.1 mm from the flange and are what is nearest to a wall ahead."""
    joints = jnp.asarray(np.append(ROBOT.home[:6], [FINGER_CLOSED] * 2))
    clearance = jax.jit(ROBOT.clearance, static_argnums=1)
    tips = START_POSE[0] - GRASP_OFFSET + 0.2311
    ahead = Box(center=(0.0, 0.1, 0.5), half_size=(0.2, 1.0, 0.5))
    turned = Box(center=(0.0, 0.1, 0.5), half_size=(1.0, 0.2, 0.5), yaw=np.pi / 2)
    for wall in (ahead, turned):
        assert float(clearance(joints, walled(wall))) == pytest.approx(-0.2 - tips, abs=2e-4)
    table = float(clearance(joints, TABLE))
    far = Box(center=(5.0, 0.0, 0.5), half_size=(0.2, 1.0, 0.5))
    assert float(clearance(joints, walled(far))) == pytest.approx(table, abs=1e-6)
    assert float(clearance(joints, walled(far, ahead))) == pytest.approx(-0.2 - tips, abs=2e-4)
    through = Box(center=(-0.3, 0.0, 0.1), half_size=(0.01, 1.0, 0.5))
    assert float(clearance(joints, walled(through))) <= 0


def test_distance_to_walls_is_mujocos():
    """Random postures between walls that are turned anyhow, all moving geoms; where geoms overlap it is 0 or less."""
    rng = np.random.default_rng(4)
    workspace = walled(
        Box(center=(0.5, 0.3, 0.3), half_size=(0.02, 0.6, 0.3), yaw=0.7),
        Box(center=(-0.2, -0.6, 0.2), half_size=(0.5, 0.03, 0.2), yaw=-0.2),
        Box(center=(-0.5, 0.4, 0.5), half_size=(0.2, 0.2, 0.1), yaw=2.0),
    )
    mj_model = compile_spec(scene_spec(ROBOT, workspace))
    data = mujoco.MjData(mj_model)
    geoms = [mj_model.geom(geom.name).id for geom in moving(LINKS)]
    walls = [mj_model.geom(f"wall_{index}").id for index in range(3)]
    joints = np.concatenate([rng.uniform(-3, 3, (60, 6)), rng.uniform(FINGER_CLOSED, FINGER_OPEN, (60, 2))], axis=1)
    joints = joints.astype(np.float32)
    distance = jax.jit(jax.vmap(lambda q: clearance.distance_to_walls(LINKS, moving(LINKS), q, workspace)))
    apart, overlapping = 0, 0
    for row, found in zip(joints, np.asarray(distance(joints)), strict=True):
        data.qpos[ROBOT.joint_qpos_ids(mj_model)] = row
        data.joint("hand_left_tip").qpos[0], data.joint("hand_right_tip").qpos[0] = -row[6], -row[7]
        mujoco.mj_kinematics(mj_model, data)
        pairs = [(wall, geom) for wall in walls for geom in geoms]
        wanted = min(mujoco.mj_geomDistance(mj_model, data, wall, geom, 3.0, None) for wall, geom in pairs)
        if wanted > 0:
            assert found == pytest.approx(wanted, abs=1e-4)
            apart += 1
        else:
            assert found <= 1e-4
            overlapping += 1
    assert apart > 10 and overlapping > 5


def test_without_walls_nothing_is_near():
    found = clearance.distance_to_walls(LINKS, LINKS.geoms, jnp.asarray(ROBOT.home), TABLE)
    assert np.isposinf(found)
