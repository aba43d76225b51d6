"""Pushes of the `mjx` engine against C MuJoCo on the same hulls and options; batches, guards and slots."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mjx_oracle import ROBOT, CoarseModel
from mujoco import mjx as mujoco_mjx

from pregrasp_jax.assets.catalogue import builtin_bank
from pregrasp_jax.physics import mjx, mjx_model
from pregrasp_jax.robot.ur5e_rg2 import FINGER_CLOSED
from pregrasp_jax.scene.model import parking_poses
from pregrasp_jax.spaces.workspace import TABLE
from pregrasp_jax.task.primitive import Stroke
from pregrasp_jax.task.push import num_push_rows, plan_push
from pregrasp_jax.types import MAX_HULLS, MAX_OBJECTS, SceneParams

NUM_SLOTS = 3
SCENES = ((0, 3, 1), (13, 8, -1))
"""Object ids of the seen set: a row of three (1, 5 and 1 hulls) and one of two (2 and 1), in front of the hand."""

NEAR = (0.010, 0.003)
"""m; how far the objects of these may end from where C leaves them, see `test_a_push_moves_objects_as_c_does`."""

ROW_START, ROW_GAP = -0.19, 0.002
"""m; where a row begins, just beyond the closed fingers, and between its objects."""


@pytest.fixture(scope="module")
def bank():
    return builtin_bank("seen")


@pytest.fixture(scope="module")
def oracle(bank):
    return CoarseModel(bank)


@pytest.fixture(scope="module")
def engine(bank):
    made = mjx.make_engine(bank, ROBOT, TABLE, num_slots=NUM_SLOTS, num_hulls=MAX_HULLS)
    return dataclasses.replace(made, init=jax.jit(made.init), reset=jax.jit(made.reset), observe=jax.jit(made.observe))


def row_of(bank, object_ids) -> SceneParams:
    """Objects [<= MAX_OBJECTS] one behind the other along x, and a little to the side of each other."""
    poses = parking_poses().astype(np.float32)
    x = ROW_START
    for slot, object_id in enumerate(object_ids):
        if object_id >= 0:
            hulls = np.asarray(bank.object_hulls)[object_id]
            low, high = np.array([f(np.asarray(bank.full.vertices)[hulls[hulls >= 0], :, 0]) for f in (np.min, np.max)])
            poses[slot, :3] = x - low, 0.01 * slot, 0.0
            x += high - low + ROW_GAP
    ids = np.append(object_ids, np.full(MAX_OBJECTS - len(object_ids), -1))
    return SceneParams(jnp.asarray(ids, jnp.int32), jnp.asarray(poses), jnp.int32(0))


@pytest.fixture(scope="module")
def plans():
    """Pushes of 10 and 7 cm with closed fingers."""
    start = jax.tree.map(jnp.asarray, ROBOT.start)
    ends = ((-0.2, 0.0), (-0.23, 0.01))
    rows = num_push_rows(0.1, 0.1)
    strokes = [Stroke(start, start.replace(xy=jnp.array(end), aperture=jnp.float32(FINGER_CLOSED))) for end in ends]
    home = jnp.asarray(ROBOT.home)
    plan = jax.jit(lambda stroke: plan_push(ROBOT, TABLE, home, stroke, push_speed=0.1, num_rows=rows))
    return [plan(stroke) for stroke in strokes]


@pytest.mark.slow
def test_kinematics_are_those_of_mjx_with_levels_that_are_not_fused(bank):
    """Every field, for a random posture; unfused, lest a pose is computed again and again (2.8 times the step)."""
    m = mjx_model.make_mjx_slot_model(bank, ROBOT, TABLE, limits=mjx.LIMITS, num_slots=NUM_SLOTS).mjx_model
    start = mujoco_mjx.make_data(m)
    data = start.replace(qpos=start.qpos + jnp.asarray(np.random.default_rng(0).normal(0, 0.3, m.nq), jnp.float32))
    functions = mjx.kinematics, mujoco_mjx.kinematics
    with jax.numpy_rank_promotion("allow"):
        ours, theirs = (jax.jit(f)(m, data) for f in functions)
        barriers = [str(jax.make_jaxpr(f)(m, data)).count("optimization_barrier") for f in functions]
    for mine, other in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(mine, other, atol=1e-6)
    assert (ours.xpos != start.xpos).any()
    assert barriers[0] > 6 and barriers[1] == 0, "one for each level of the arm"


def stack(items):
    return jax.tree.map(lambda *x: jnp.stack(x), *items)


@pytest.fixture(scope="module")
def pushed(bank, engine, plans):
    """(run of a batch, its traces, states before and after a batch of both scenes)."""
    traces = []

    def counted(state, ctrl, num_ctrl):
        traces.append(1)
        return engine.run(state, ctrl, num_ctrl)

    run = jax.jit(jax.vmap(counted))
    states = stack([engine.reset(engine.init(), row_of(bank, scene)) for scene in SCENES])
    both = stack(plans)
    return run, traces, states, run(states, both.ctrl, both.num_ctrl)


def test_a_push_moves_objects_as_c_does(bank, oracle, engine, plans, pushed):
    """Same hulls and options: final poses near those of C after pushes that move them by 17 and 47 mm.

    How near can be asked, measured with start poses shifted at random: in the row of three, 1e-7 m (the rounding of
    float32) moves C by 3.0 to 3.6 mm, this engine by up to 6 mm, and by 0.05 mm where jax computes in float64. In the
    row of two it is C by 2 um, this engine by 0.4 mm, in float64 by 1 um. What is left in float64, 2.6 and 0.8 mm, is
    not rounding; other contacts, where C stops short of the least translation, are the suspect but not isolated.
    """
    *_, after = pushed
    seen = jax.jit(jax.vmap(engine.observe))(after)
    for i, object_ids in enumerate(SCENES):
        count = sum(o >= 0 for o in object_ids)
        poses = np.asarray(row_of(bank, object_ids).poses, np.float64)
        data = oracle.fill(np.array(object_ids), poses[: len(object_ids)])
        reference = oracle.push(data, np.asarray(plans[i].ctrl), int(plans[i].num_ctrl))
        moved = np.linalg.norm(reference[:count, :2] - poses[:count, :2], axis=1)
        error = np.linalg.norm(np.asarray(seen.object_poses)[i, :count, :3] - reference[:count, :3], axis=1)
        assert moved.min() > 0.01
        assert error.max() < NEAR[i], (moved, error)
        np.testing.assert_allclose(seen.joint_pos[i], data.qpos[ROBOT.joint_qpos_ids(oracle.model)], atol=2e-3)
    assert not seen.diverged.any()
    assert not after.overflows.any()
    assert after.max_contacts.min() > 4


@pytest.mark.parametrize("scene", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_scenes_do_not_depend_on_their_batch(plans, pushed, scene):
    """Two sets of objects, of different number: the same bits beside any neighbour, and the same as alone.

    Alone means beside itself: a batch of one is another XLA program, of other rounding (the slow test below).
    """
    run, _, states, after = pushed
    both = stack(plans)
    twice, plan = jax.tree.map(lambda x: jnp.stack([x[scene]] * 2), (states, both))
    same = run(twice, plan.ctrl, plan.num_ctrl)
    np.testing.assert_array_equal(same.qpos[0], after.qpos[scene])
    np.testing.assert_array_equal(same.qpos[1], after.qpos[scene])


@pytest.mark.slow
def test_a_batch_of_one_differs_by_rounding_only(engine, plans, pushed):
    """Compared before contact has amplified the rounding."""
    run, _, states, _ = pushed
    both = stack(plans)
    short = run(states, both.ctrl, jnp.array([15, 10]))
    alone = jax.jit(engine.run)
    for i, rows in enumerate((15, 10)):
        state = alone(jax.tree.map(lambda x, i=i: x[i], states), plans[i].ctrl, jnp.int32(rows))
        np.testing.assert_allclose(state.qpos, short.qpos[i], atol=1e-4)


def test_parked_slots_stay_and_finished_scenes_freeze(engine, plans, pushed):
    run, _, states, after = pushed
    np.testing.assert_allclose(after.qpos[1][-7:], states.qpos[1][-7:], atol=1e-5)
    both = stack(plans)
    frozen = run(states, both.ctrl, jnp.array([1, 0]))
    for old, new in zip(jax.tree.leaves(states), jax.tree.leaves(frozen), strict=True):
        np.testing.assert_array_equal(old[1], new[1])
    assert (frozen.qpos[0] != states.qpos[0]).any()


def test_only_the_scene_that_diverges_ends(plans, pushed):
    """Too fast, too deep, below the table, not a number: that scene keeps its last state, the other one goes on."""
    run, _, states, _ = pushed
    both = stack(plans)
    slot = states.qpos.shape[1] - 21
    broken = {
        "fast": states.replace(qvel=states.qvel.at[0, -15].set(150.0)),
        "deep": states.replace(qpos=states.qpos.at[0, slot + 7 : slot + 10].set(states.qpos[0, slot : slot + 3])),
        "fallen": states.replace(qpos=states.qpos.at[0, slot + 2].set(-0.06)),
        "nan": states.replace(qpos=states.qpos.at[0, slot].set(jnp.nan)),
    }
    for name, bad in broken.items():
        after = run(bad, both.ctrl, jnp.array([2, 2]))
        np.testing.assert_array_equal(after.diverged, [True, False], err_msg=name)
        np.testing.assert_array_equal(after.qpos[0], bad.qpos[0], err_msg=name)
        assert (after.qpos[1] != bad.qpos[1]).any(), name
        again = run(after, both.ctrl, jnp.array([2, 2]))
        np.testing.assert_array_equal(again.diverged, [True, False], err_msg=name)
        np.testing.assert_array_equal(again.qpos[0], bad.qpos[0], err_msg=name)


def test_one_trace_serves_all_objects(pushed):
    """Runs last of those that use the fixture: batches of other objects and plans did not trace again."""
    assert len(pushed[1]) == 1


def test_a_scene_may_start_in_the_mirror_image_of_the_arm(bank, engine):
    starts = [engine.observe(engine.reset(engine.init(), row_of(bank, (0, 1)), mirrored)) for mirrored in (False, True)]
    np.testing.assert_allclose([seen.joint_pos for seen in starts], ROBOT.homes, atol=1e-6)
    np.testing.assert_array_equal(starts[0].object_poses, starts[1].object_poses)


def test_a_scene_with_more_objects_than_slots_is_marked(bank, engine):
    scene = row_of(bank, (0, 1, 2))
    assert not engine.observe(engine.reset(engine.init(), scene)).diverged
    fourth = dataclasses.replace(scene, object_ids=scene.object_ids.at[NUM_SLOTS].set(1))
    assert engine.observe(engine.reset(engine.init(), fourth)).diverged


@pytest.mark.slow
def test_three_thousand_steps_do_not_hang(engine, plans, pushed):
    """On two cores MJX programs deadlock unless the package has raised NPROC (9 of 9 runs hung within 103 steps)."""
    run, _, state, _ = pushed
    hold = jnp.broadcast_to(jnp.asarray(ROBOT.home[:7]), (2, *plans[0].ctrl.shape))
    rows = plans[0].ctrl.shape[0]
    steps = 0
    while steps < 3000:
        state = jax.block_until_ready(run(state, hold, jnp.array([rows, rows])))
        steps += 5 * rows
    assert not state.diverged.any()
