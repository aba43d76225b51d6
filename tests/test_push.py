import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pregrasp_jax.robot import description, get_robot, kinematics
from pregrasp_jax.robot.base import hand_pose_of
from pregrasp_jax.robot.ur5e_rg2 import FINGER_CLOSED, FINGER_OPEN
from pregrasp_jax.spaces import grid, motion
from pregrasp_jax.spaces.workspace import TABLE
from pregrasp_jax.task import push
from pregrasp_jax.task.primitive import Stroke
from pregrasp_jax.types import CTRL_DT, OBSTRUCTIONS

ROBOT = get_robot("ur5e_rg2")
SPEED = 0.1
NUM_ROWS = push.num_push_rows(0.15, SPEED)
PLAN = jax.jit(functools.partial(push.plan_push, ROBOT, TABLE, push_speed=SPEED, num_rows=NUM_ROWS))


def plan(start, end, before=FINGER_OPEN, after=FINGER_OPEN, *, yaw=0.0, z=0.1):
    here = hand_pose_of((0.0, 0.0), z=0.1, yaw=0.0, aperture=before).replace(xy=jnp.asarray(start, jnp.float32))
    there = hand_pose_of((0.0, 0.0), z=z, yaw=yaw, aperture=after).replace(xy=jnp.asarray(end, jnp.float32))
    return PLAN(jnp.asarray(ROBOT.home), Stroke(here, there))


def loop_mask(p1, r_in, r_out, full):
    mask = np.zeros((100, 100), bool)
    for row in range(100):
        for col in range(100):
            x, y = -0.25 + 0.005 * (col + 0.5), -0.25 + 0.005 * (row + 0.5)
            r, theta = np.hypot(x - p1[0], y - p1[1]), np.arctan2(y - p1[1], x - p1[0])
            ahead = full or abs(theta) <= np.pi / 2 + 1e-6
            mask[row, col] = ahead and r_in - 1e-6 <= r <= r_out + 1e-6
    return mask


@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("p1", [(-0.30, 0.0), (0.0025, 0.0025), (0.2475, -0.2475), (0.4, 0.0)])
def test_half_ring_is_the_loop_over_cells(p1, full):
    mask = grid.half_ring(jnp.array(p1), r_in=0.04, r_out=0.15, full=full)
    np.testing.assert_array_equal(mask, loop_mask(p1, 0.04, 0.15, full))


def test_half_ring_ends_are_inclusive():
    p1 = grid.cell_to_world(jnp.int32(50), jnp.int32(20))
    mask = grid.half_ring(p1, r_in=0.04, r_out=0.15)
    assert mask[50, 28] and not mask[50, 27], "r_in = 8 cells straight ahead"
    assert mask[50, 50] and not mask[50, 51], "r_out = 30 cells straight ahead"
    assert mask[80, 20] and mask[20, 20] and not mask[80, 19], "exactly sideways belongs to it, backward does not"


def test_half_ring_is_mirror_symmetric():
    up = grid.half_ring(jnp.array([-0.1, 0.03]), r_in=0.04, r_out=0.15)
    down = grid.half_ring(jnp.array([-0.1, -0.03]), r_in=0.04, r_out=0.15)
    np.testing.assert_array_equal(up, down[::-1])


def test_minimum_jerk_meets_its_boundary_conditions():
    np.testing.assert_allclose(motion.minimum_jerk(jnp.array([-1.0, 0.0, 0.5, 1.0, 2.0])), [0, 0, 0.5, 1, 1])
    velocity = jax.vmap(jax.grad(motion.minimum_jerk))(jnp.array([1e-3, 0.5, 1 - 1e-3]))
    np.testing.assert_allclose(velocity, [0, 1.875, 0], atol=1e-4)


def test_push_times_and_fingers():
    kept = plan((-0.3, 0.0), (-0.2, 0.0))
    changed = plan((-0.3, 0.0), (-0.2, 0.0), FINGER_OPEN, FINGER_CLOSED)
    assert kept.num_ctrl == math.ceil((1.0 + push.SETTLE_TIME) / CTRL_DT)
    assert changed.num_ctrl - kept.num_ctrl == round(push.APERTURE_TIME / CTRL_DT)
    fingers = np.asarray(changed.ctrl[:, 6])
    assert fingers[0] == pytest.approx(FINGER_OPEN)
    assert fingers[int(push.APERTURE_TIME / CTRL_DT) + 1] == pytest.approx(FINGER_CLOSED, abs=1e-6)
    still = np.asarray(changed.ctrl[: int(push.APERTURE_TIME / CTRL_DT), :6])
    np.testing.assert_allclose(still, np.broadcast_to(still[0], still.shape), atol=1e-5)


def test_plan_ends_at_p2():
    path = plan((-0.3, 0.0), (-0.2, 0.11))
    assert path.reachable
    hand = jax.vmap(functools.partial(kinematics.grasp_pose, description.arm()))(
        path.ctrl[int(path.num_ctrl) - 5 : int(path.num_ctrl), :6]
    )
    np.testing.assert_allclose(hand[:, :3], np.tile([-0.2, 0.11, 0.1], (5, 1)), atol=1e-4)


@pytest.mark.parametrize("end", [(-0.1, 0.0), (-0.3, 0.25)])
def test_too_long_or_short_plans(end):
    longer = np.hypot(end[0] + 0.3, end[1]) > 0.15 + 0.06
    assert bool(plan((-0.3, 0.0), end).reachable) is not longer


def test_out_of_reach_is_unreachable():
    far = jnp.array([[-0.3 + 0.004 * i, 0.0, 0.1, 1.0, 0.0, 0.0, 0.0] for i in range(200)])
    follow = jax.jit(lambda joints, poses, fingers: ROBOT.follow(joints, poses, fingers, TABLE))
    commands, code = follow(jnp.asarray(ROBOT.home), far, jnp.full(200, FINGER_OPEN))
    assert code[5] == OBSTRUCTIONS.index("none") and code[-1] == OBSTRUCTIONS.index("no_ik")
    assert np.isfinite(commands).all(), "a missing solution must not leak NaN into the controls"


def test_plan_traces_once():
    count = 0

    def traced(end):
        nonlocal count
        count += 1
        return plan((-0.3, 0.0), end).num_ctrl

    jitted = jax.jit(traced)
    jitted(jnp.array([-0.2, 0.0]))
    jitted(jnp.array([-0.2, 0.1]))
    assert count == 1


def test_a_push_that_is_refused_says_why_and_executes_nothing():
    for end, z, reason in (
        ((-0.1, 0.0), 0.1, "none"),
        ((-0.05, 0.0), 0.1, "too_long"),
        ((-0.2, 0.0), -0.05, "table"),
        ((-0.2, 0.0), 1.4, "joint_limit"),  # faster than a joint can turn
    ):
        found = plan((-0.3, 0.0), end, z=z)
        assert OBSTRUCTIONS[int(found.obstruction)] == reason, end
        assert bool(found.reachable) == (reason == "none")
        assert (int(found.num_ctrl) > 0) == (float(found.seconds) > 0) == (reason == "none")


def test_the_hand_turns_the_shorter_way_and_changes_its_height_on_the_way():
    found = plan((-0.3, 0.0), (-0.2, 0.05), yaw=0.4, z=0.15)
    assert found.reachable
    hand = jax.vmap(functools.partial(kinematics.grasp_pose, description.arm()))(found.ctrl[:, :6])
    np.testing.assert_allclose(hand[0, :3], [-0.3, 0.0, 0.1], atol=1e-4)
    np.testing.assert_allclose(hand[-1], [-0.2, 0.05, 0.15, math.cos(0.2), 0, 0, math.sin(0.2)], atol=1e-4)
    around = plan((-0.3, 0.0), (-0.2, 0.05), yaw=0.4 - 2 * math.pi, z=0.15)
    np.testing.assert_allclose(around.ctrl, found.ctrl, atol=1e-4)
    early = hand[int(0.2 / CTRL_DT)]
    assert 0.1 < early[2] < 0.15 and 0 < early[6] < math.sin(0.2)


def test_a_half_ring_turns_with_the_hand():
    ahead = np.asarray(grid.half_ring(np.array([0.0, 0.0]), r_in=0.04, r_out=0.15))
    left = np.asarray(grid.half_ring(np.array([0.0, 0.0]), r_in=0.04, r_out=0.15, yaw=np.pi / 2))
    np.testing.assert_array_equal(left, ahead.T)
