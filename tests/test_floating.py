"""A floating hand goes where it is sent, with fingers and without, and says what keeps it from where it cannot go."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from pregrasp_jax.assets.catalogue import builtin_bank
from pregrasp_jax.geometry import quat_from_yaw
from pregrasp_jax.robot.base import ClosingRegion, Eligibility, first_obstruction, hand_pose_of
from pregrasp_jax.robot.floating import JOINTS, make_floating_hand
from pregrasp_jax.scene.model import make_slot_model
from pregrasp_jax.scene.spec import compile_spec, scene_spec
from pregrasp_jax.spaces.motion import minimum_jerk
from pregrasp_jax.spaces.workspace import TABLE, Box, Workspace
from pregrasp_jax.types import CTRL_DT, OBSTRUCTIONS

GRIPPER = """
<mujoco>
  <worldbody>
    <body name="palm">
      <geom name="palm" type="box" pos="-0.06 0 0" size="0.01 0.06 0.02" mass="0.5"/>
      <body name="left" pos="-0.05 0.03 0">
        <joint name="left" type="hinge" axis="0 0 1" armature="0.002" damping="0.05"/>
        <geom name="left" type="box" pos="0.04 0 0" size="0.04 0.006 0.02" mass="0.05"/>
      </body>
      <body name="right" pos="-0.05 -0.03 0">
        <joint name="right" type="hinge" axis="0 0 1" armature="0.002" damping="0.05"/>
        <geom name="right" type="box" pos="0.04 0 0" size="0.04 0.006 0.02" mass="0.05"/>
      </body>
    </body>
  </worldbody>
  <equality><joint joint1="right" joint2="left" polycoef="0 -1 0 0 0"/></equality>
  <actuator><position name="left" joint="left" kp="4" kv="0.1"/></actuator>
</mujoco>
"""
START = hand_pose_of((-0.30, 0.05), z=0.08, yaw=0.3, aperture=0.4)


def make(mjcf: str = GRIPPER, fingers=("left",)):
    return make_floating_hand(
        "gripper",
        mjcf,
        start=START,
        closing_region=lambda aperture: ClosingRegion(np.array([-0.05, 0.03]), np.full(2, 0.03), aperture > 0),
        eligibility=lambda bank: Eligibility(np.ones(len(bank.names), bool), ("",) * len(bank.names)),
        fingers=fingers,
    )


@pytest.fixture(scope="module")
def robot():
    return make()


def at_home(robot, workspace=TABLE):
    mj_model = compile_spec(scene_spec(robot, workspace))
    data = mujoco.MjData(mj_model)
    robot.set_home(mj_model, data)
    return mj_model, data


def path(rows, *, x=0.0, y=0.0, z=0.08, yaw=0.0):
    """Return poses [rows, 7] on a line from the start; the last quarter stands still."""
    share = np.asarray(minimum_jerk(jnp.linspace(0, 1.33, rows)))
    xyz = np.stack([a + share * (b - a) for a, b in zip((*START.xy, START.z), (x, y, z), strict=True)], axis=1)
    quats = jax.vmap(quat_from_yaw)(jnp.asarray(START.yaw + share * (yaw - START.yaw), jnp.float32))
    return jnp.concatenate([jnp.asarray(xyz, jnp.float32), quats], axis=1)


def test_it_starts_at_the_start_with_coupled_fingers_open(robot):
    mj_model, data = at_home(robot)
    hand = data.body("hand_palm")
    np.testing.assert_allclose(hand.xpos, [*START.xy, START.z], atol=1e-6)
    np.testing.assert_allclose(robot.hand_pose(jnp.asarray(robot.home))[:3], hand.xpos, atol=1e-6)
    np.testing.assert_allclose(robot.hand_pose(jnp.asarray(robot.home))[3:], hand.xquat, atol=1e-6)
    assert data.joint("hand_left").qpos[0] == pytest.approx(0.4)
    assert data.joint("hand_right").qpos[0] == pytest.approx(-0.4)
    mujoco.mj_step(mj_model, data, 200)
    np.testing.assert_allclose(data.qpos[robot.joint_qpos_ids(mj_model)], robot.home, atol=2e-3)


def test_its_links_are_where_mujoco_has_them(robot):
    mj_model, data = at_home(robot)
    joint_pos = np.array([0.1, -0.2, 0.15, 2.0, 0.25], np.float32)
    data.qpos[robot.joint_qpos_ids(mj_model)] = joint_pos
    data.joint("hand_right").qpos[0] = -joint_pos[4]
    mujoco.mj_kinematics(mj_model, data)
    poses = jax.jit(robot.links.poses)(jnp.asarray(joint_pos))
    found = np.array([data.body(name).xpos for name in robot.links.names])
    np.testing.assert_allclose(poses[:, :3], found, atol=1e-6)


def test_it_collides_with_objects_and_table_and_needs_no_force_against_gravity(robot):
    mj_model, _ = at_home(robot)
    geoms = [mj_model.geom(geom.name) for geom in robot.links.geoms]
    assert len(geoms) == 3 and all(g.contype[0] == 2 and g.conaffinity[0] == 1 for g in geoms)
    bodies = [mj_model.body(name).id for name in robot.links.names]
    assert (mj_model.body_gravcomp[bodies] == 1).all()


def test_it_follows_a_turning_path_within_a_millimetre(robot):
    mj_model, data = at_home(robot)
    poses = path(100, x=0.05, y=-0.10, z=0.12, yaw=-2.0)
    apertures = jnp.linspace(0.4, 0.1, 100)
    ctrl, code = jax.jit(robot.follow, static_argnums=3)(jnp.asarray(robot.home), poses, apertures, TABLE)
    assert not code.any() and ctrl.shape == (100, len(robot.actuators))
    ids = [mj_model.actuator(name).id for name in robot.actuators]
    for row in np.asarray(ctrl):
        data.ctrl[ids] = row
        mujoco.mj_step(mj_model, data, round(CTRL_DT / mj_model.opt.timestep))
    np.testing.assert_allclose(data.body("hand_palm").xpos, poses[-1, :3], atol=1e-3)
    assert data.joint("hand_left").qpos[0] == pytest.approx(0.1, abs=0.01)


def test_a_hand_that_has_turned_around_does_not_unwind(robot):
    joint_pos = jnp.asarray(robot.home).at[3].set(0.3 + 2 * np.pi)
    ctrl, _ = jax.jit(robot.follow, static_argnums=3)(joint_pos, path(20, yaw=0.3), jnp.full(20, 0.4), TABLE)
    np.testing.assert_allclose(ctrl[:, 3], 0.3 + 2 * np.pi, atol=1e-4)


@pytest.mark.parametrize(
    ("end", "reason"),
    [({"x": 0.1}, "none"), ({"x": 0.5}, "joint_limit"), ({"z": 0.01}, "table"), ({"y": 0.2}, "wall")],
)
def test_the_code_of_a_row_says_what_is_in_the_way(robot, end, reason):
    walled = Workspace(name="walled", walls=(Box(center=(0.0, 0.27, 0.1), half_size=(0.25, 0.02, 0.1)),))
    _, code = jax.jit(robot.follow, static_argnums=3)(
        jnp.asarray(robot.home), path(30, **end), jnp.full(30, 0.4), walled
    )
    assert OBSTRUCTIONS[int(code[-1])] == reason and code[0] == 0


def test_only_walls_are_kept_clear_of(robot):
    low = jnp.asarray(robot.home).at[2].set(0.021)
    assert robot.clearance(low, TABLE) == jnp.inf
    wall = Box(center=(-0.30, 0.20, 0.1), half_size=(0.3, 0.02, 0.1))
    walled = Workspace(name="w", walls=(wall,))
    distance = jax.jit(lambda joints: robot.clearance(joints, walled))(jnp.asarray(robot.home).at[3].set(0.0))
    assert float(distance) == pytest.approx(0.18 - (0.05 + 0.03 + 0.08 * np.sin(0.4) + 0.006 * np.cos(0.4)), abs=1e-4)


def test_the_first_name_that_holds_is_the_reason():
    holds = {"joint_limit": jnp.array([False, True, True]), "table": jnp.array([True, True, False])}
    assert [OBSTRUCTIONS[c] for c in first_obstruction(holds)] == ["table", "joint_limit", "joint_limit"]


def test_a_hand_may_hold_meshes_and_geoms_without_names(robot):
    """As what is left of a maker's file once its visual geoms are gone."""
    corners = "0 0 0  1 0 0  0 1 0  0 0 1"
    mjcf = GRIPPER.replace("<worldbody>", f'<asset><mesh name="m" vertex="{corners}"/></asset><worldbody>', 1)
    kept = make(mjcf.replace('geom name="palm"', "geom"))
    assert [geom.name for geom in kept.links.geoms].count("") == 0
    assert len({geom.name for geom in kept.links.geoms}) == len(robot.links.geoms)
    bank = builtin_bank("seen")
    plain, with_mesh = (make_slot_model(scene_spec(hand, TABLE), bank) for hand in (robot, kept))
    for name in ("geom_size", "geom_friction", "body_mass"):
        np.testing.assert_array_equal(with_mesh.fields[name], plain.fields[name])
    hulls = [[model.mj_model.mesh(i).name for i in model.fields["geom_dataid"][:, 0]] for model in (plain, with_mesh)]
    assert hulls[0] == hulls[1]


def test_refusals(robot):
    two = "<mujoco><worldbody><body name='a'/><body name='b'/></worldbody></mujoco>"
    with pytest.raises(ValueError, match="gripper holds 2 bodies; allowed is one"):
        make(two, ())
    two_drives = GRIPPER.replace("</actuator>", '<position name="right" joint="right" kp="4"/></actuator>')
    with pytest.raises(ValueError, match="actuators of hand gripper are left, right; allowed are right, left, in this"):
        make(two_drives, ("right", "left"))
    ball = "<mujoco><worldbody><body name='a'><geom size='0.1'/></body></worldbody></mujoco>"
    with pytest.raises(ValueError, match="capsule or a box"):
        make(ball, ())
    for old, new, said in (
        ('<body name="palm">', '<body name="palm" pos="0 0 0.05">', "body of hand gripper stands at .*0.05"),
        (
            'name="left" type="hinge"',
            'name="left" type="hinge" pos="0 0.06 0"',
            "left' of the robot has a pos or a ref",
        ),
        ('name="left" type="hinge"', 'name="left" type="hinge" ref="0.2"', "left' of the robot has a pos or a ref"),
        ("0 -1 0 0 0", "0.1 -1 0 0 0", "right' of the robot follows by polycoef .*0.1, -1.0.* allowed is a ratio"),
    ):
        with pytest.raises(ValueError, match=said):
            make(GRIPPER.replace(old, new))
    assert robot.joints[:4] == JOINTS
