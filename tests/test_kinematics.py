"""Kinematics against MuJoCo's own, and the closed-form inverse against the forward."""

import itertools
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from pregrasp_jax import geometry
from pregrasp_jax.robot import description, get_robot, kinematics
from pregrasp_jax.spaces.workspace import TABLE

ROBOT = get_robot("ur5e_rg2")
ARM = description.arm()
NUM = 400
BRANCHES = list(itertools.product((1, -1), repeat=3))

forward = jax.jit(jax.vmap(partial(kinematics.forward_kinematics, ARM)))
inverse = jax.jit(jax.vmap(partial(kinematics.inverse_kinematics, ARM)))
hand_inverse = jax.jit(jax.vmap(partial(kinematics.hand_inverse_kinematics, ARM)))
grasp_poses = jax.jit(jax.vmap(partial(kinematics.grasp_pose, ARM)))


def random_joints(seed=0):
    return np.random.default_rng(seed).uniform(-np.pi, np.pi, (NUM, 6)).astype(np.float32)


def workspace_poses():
    x, y = np.meshgrid(np.linspace(-0.3, 0.25, 12), np.linspace(-0.25, 0.25, 11))
    poses = np.zeros((x.size, 7), np.float32)
    poses[:, 0], poses[:, 1], poses[:, 2], poses[:, 3] = x.ravel(), y.ravel(), 0.1, 1.0
    return poses


def turn_between(a, b):
    """Angle [...] rad between rotation matrices, accurate for small angles."""
    return np.linalg.norm(np.swapaxes(a, -1, -2) @ b - np.eye(3), axis=(-2, -1)) / np.sqrt(2)


def test_dh_parameters_are_the_makers():
    a, d, alpha = description.dh_parameters()
    np.testing.assert_allclose(a, [0, -0.425, -0.3922, 0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(d, [0.1625, 0, 0, 0.1333, 0.0997, 0.0996], atol=1e-9)
    np.testing.assert_allclose(alpha, [np.pi / 2, 0, 0, np.pi / 2, -np.pi / 2, 0], atol=1e-6)


def test_forward_kinematics_at_zero_by_hand():
    # Stretched along -x of the base: the wrist's offsets add up sideways and downwards.
    flange = np.asarray(kinematics.forward_kinematics(ARM, jnp.zeros(6)))[-1]
    np.testing.assert_allclose(flange[:3, 3], [-0.8172, -(0.1333 + 0.0996), 0.1625 - 0.0997], atol=1e-6)
    np.testing.assert_allclose(flange[:3, 2], [0, -1, 0], atol=1e-6)


def test_grasp_pose_is_mujocos():
    mj_model = description.robot_model()
    data = mujoco.MjData(mj_model)
    joints = random_joints()
    poses = np.asarray(grasp_poses(joints))
    for row, pose in zip(joints, poses, strict=True):
        data.qpos[ROBOT.joint_qpos_ids(mj_model)[:6]] = row
        mujoco.mj_kinematics(mj_model, data)
        np.testing.assert_allclose(pose[:3], data.site("grasp_point").xpos, atol=1e-6)
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, pose[3:].astype(np.float64))
        np.testing.assert_allclose(rotation, data.site("grasp_point").xmat, atol=2e-6)
        assert pose[3] >= 0


@pytest.mark.parametrize("targets", ["anywhere", "workspace"])
def test_forward_of_inverse_is_the_identity(targets):
    if targets == "anywhere":
        wanted = np.asarray(forward(random_joints())[:, -1])
    else:
        wanted = np.asarray(jax.vmap(partial(kinematics.flange_from_hand_pose, ARM))(jnp.asarray(workspace_poses())))
    solutions = np.asarray(inverse(wanted))
    exists = np.asarray(np.isfinite(solutions).all(axis=-1))
    np.testing.assert_array_equal(np.isnan(solutions).all(axis=-1), ~exists)
    assert exists.any(axis=1).all()
    if targets == "workspace":
        assert exists.all()
    reached = np.asarray(jax.vmap(forward)(np.nan_to_num(solutions)))[:, :, -1]
    position = np.linalg.norm(reached[..., :3, 3] - wanted[:, None, :3, 3], axis=-1)
    angle = turn_between(reached[..., :3, :3], np.broadcast_to(wanted[:, None, :3, :3], (*position.shape, 3, 3)))
    # 0.05 mm and 1e-4 rad are asked for; float32 gives about a tenth of that.
    assert position[exists].max() < 5e-6 and angle[exists].max() < 2e-5


def test_one_branch_is_the_posture_it_came_from():
    joints = random_joints(1)
    solutions = np.asarray(inverse(forward(joints)[:, -1]))
    apart = np.abs((solutions - joints[:, None] + np.pi) % (2 * np.pi) - np.pi).max(axis=-1)
    nearest = np.nanmin(apart, axis=1)
    # At a stretched or folded elbow the angle is worth its square root in position, so the worst case is loose.
    assert np.median(nearest) < 1e-5 and nearest.max() < 0.05


def test_the_branches_come_in_the_documented_order():
    solutions = np.asarray(hand_inverse(workspace_poses()))
    for index, (shoulder, wrist, elbow) in enumerate(BRANCHES):
        assert (np.sign(solutions[:, index, 4]) == wrist).all() and (np.sign(solutions[:, index, 2]) == elbow).all()
        # The wrist (frame 5) lies ahead in the direction that q1 = 0 stretches away from, or behind.
        along = [
            np.dot(kin[5, :2, 3], [np.cos(q[0]), np.sin(q[0])])
            for q, kin in zip(solutions[:, index], np.asarray(forward(solutions[:, index])), strict=True)
        ]
        assert (np.sign(along) == shoulder).all()
    assert len({tuple(np.round(row, 3)) for row in solutions[5]}) == 8


def test_out_of_reach_is_nan():
    far, near_axis = np.eye(4, dtype=np.float32), np.eye(4, dtype=np.float32)
    far[:3, 3] = [1.2, 0, 0.2]
    near_axis[:3, 3] = [0.05, 0, 0.4]  # nearer to the base axis than the arm's lateral offset of 133 mm
    assert np.isnan(np.asarray(inverse(np.stack([far, near_axis])))).all()


def test_wrist_singularity_keeps_the_pose():
    joints = random_joints(2)
    joints[:, 4] = np.where(np.arange(NUM) % 2, 0.0, np.float32(np.pi))
    wanted = np.asarray(forward(joints)[:, -1])
    solutions = np.asarray(inverse(wanted))
    exists = np.asarray(np.isfinite(solutions).all(axis=-1))
    assert exists.any(axis=1).all()
    reached = np.asarray(jax.vmap(forward)(np.nan_to_num(solutions)))[:, :, -1]
    error = np.abs(reached - wanted[:, None]).max(axis=(-2, -1))
    assert error[exists].max() < 1e-4


def test_branches_are_unwrapped_one_by_one_and_missing_ones_stay_missing():
    reference = jnp.array([3.1, 0, 0, 0, 0, 0])
    solutions = jnp.full((8, 6), jnp.nan).at[3].set(jnp.array([-3.1, 0, 0, 0, 0, 0])).at[6].set(jnp.ones(6))
    found = np.asarray(kinematics.unwrap_near(ARM, solutions, reference))
    np.testing.assert_allclose(found[3], [2 * np.pi - 3.1, 0, 0, 0, 0, 0], atol=1e-6)
    np.testing.assert_allclose(found[6], np.ones(6), atol=1e-6)
    assert np.isnan(np.delete(found, [3, 6], axis=0)).all()


def test_a_path_keeps_the_branch_that_is_nearest_to_the_current_joints():
    """From every posture of the start pose a short path is followed without a jump, in that posture."""
    start = np.array([-0.3, 0.0, 0.1, 1, 0, 0, 0], np.float32)
    path = jnp.asarray(start + np.linspace(0, 0.02, 10)[:, None] * np.eye(7, dtype=np.float32)[0])
    postures = np.asarray(jax.jit(partial(kinematics.hand_inverse_kinematics, ARM))(jnp.asarray(start)))
    follow = jax.jit(lambda joints: ROBOT.follow(joints, path, jnp.zeros(10), TABLE)[0])
    followed = 0
    for posture in postures[np.isfinite(postures).all(axis=1)]:
        controls = np.asarray(follow(jnp.asarray(np.append(posture, [0, 0]), jnp.float32)))[:, :6]
        np.testing.assert_allclose(controls[0], posture, atol=0.1)
        assert np.abs(np.diff(controls, axis=0)).max() < 0.2
        followed += 1
    assert followed == 8


def test_unwrapping_respects_the_limits():
    # The elbow turns by half a turn only, so a whole turn more is never allowed; joint 0 may.
    joints = jnp.array([-3.0, 0, -3.0, 0, 0, 0])
    found = np.asarray(kinematics.unwrap_near(ARM, joints, jnp.array([3.0, 0, 3.0, 0, 0, 0])))
    np.testing.assert_allclose(found, [2 * np.pi - 3, 0, -3, 0, 0, 0], atol=1e-6)


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0, 0.8], [0.48, 0.64, 0.6]])
@pytest.mark.parametrize("angle", [0.0, 1e-3, 1.5, 3.14159])
def test_matrix_to_pose(axis, angle):
    quat = np.array([np.cos(angle / 2), *(np.sin(angle / 2) * np.array(axis))])
    pose = np.asarray(geometry.matrix_to_pose(jnp.asarray(description.pose_to_matrix(np.array([1, 2, 3]), quat))))
    np.testing.assert_allclose(pose, [1, 2, 3, *quat], atol=1e-6)
