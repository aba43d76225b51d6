"""The `mjx` engine against C MuJoCo on the same hulls and options, and against exact geometry."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mjx_contacts import ALIKE, AMPLE, UNIQUE, Pair, make_contacts_of, touching_pairs
from mjx_oracle import CoarseModel
from mujoco import mjx as mujoco_mjx

from pregrasp_jax import primitives
from pregrasp_jax.assets.catalogue import builtin_bank
from pregrasp_jax.config import SceneConfig
from pregrasp_jax.physics import mjx, mjx_model
from pregrasp_jax.physics.hull_collision import ContactCounts, Limits
from pregrasp_jax.robot import model as robot
from pregrasp_jax.scene import bank as scene_bank
from pregrasp_jax.scene.model import parking_poses
from pregrasp_jax.types import CLOSED, MAX_HULLS, MAX_OBJECTS, OPEN, SceneParams

ROOT = Path(__file__).parent.parent
NUM_STATES = 100
"""The benchmark mjx_agreement.py has 200."""

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
def model(bank):
    return mjx_model.make_mjx_slot_model(bank, limits=AMPLE)


@pytest.fixture(scope="module")
def oracle(bank):
    return CoarseModel(bank)


def test_c_gets_the_options_of_mjx(model, oracle):
    for name in ("cone", "impratio", "solver", "iterations", "ls_iterations", "jacobian", "integrator", "timestep"):
        assert getattr(oracle.model.opt, name) == getattr(model.mj_model.opt, name), name
    damped = mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    assert oracle.model.opt.disableflags & damped == model.mj_model.opt.disableflags & damped
    assert set(oracle.model.geom_condim) == set(model.mj_model.geom_condim) == {3}


@pytest.fixture(scope="module")
def pairs(bank, model, oracle) -> list[Pair]:
    scenes = scene_bank.load_or_build(bank, SceneConfig(test_scenes=3), "test")
    return touching_pairs(model, oracle, make_contacts_of(model), scenes, NUM_STATES)


def solid(pairs) -> list[Pair]:
    """Return pairs of hulls and boxes."""
    return [pair for pair in pairs if pair.normal is not None]


def test_the_same_pairs_touch(pairs):
    """All pairs that C finds deeper than 10 um, and none that it does not: no absent hull, no parked slot."""
    kinds = {"table": 0, "hulls": 0, "box": 0, "capsule": 0}
    for pair in pairs:
        kinds[pair.kind] += 1
        if (pair.ours is None) != (pair.reference is None):
            assert max(touch.dist for touch in pair[2:4] if touch) > -1e-5, pair
    assert min(kinds[kind] for kind in ("table", "hulls", "box")) > NUM_STATES
    assert kinds["capsule"] > NUM_STATES / 8


def test_contacts_with_the_table_agree_with_c(pairs):
    for pair in pairs:
        if pair.kind == "table" and pair.ours and pair.reference:
            assert pair.ours.dist == pytest.approx(pair.reference.dist, abs=1e-6)
            np.testing.assert_allclose(pair.ours.normal, pair.reference.normal, atol=1e-6)


def test_contacts_with_capsules_agree_with_c(pairs):
    """With `mj_geomDistance` always, and with C's contacts where those do (48 of 56 in 200 states); normals too."""
    both = [pair for pair in pairs if pair.kind == "capsule" and pair.ours and pair.reference]
    for pair in both:
        assert pair.ours.dist == pytest.approx(-pair.least, abs=2e-5), pair
    exact = [pair for pair in both if pair.reference_is_exact]
    assert len(exact) > 0.8 * len(both)
    for pair in exact:
        assert pair.ours.normal @ pair.reference.normal > np.cos(ALIKE), pair


def test_the_least_translation_is_exact(pairs):
    """Distance and normal against the Minkowski difference: 20 um, of which 10 um are the preference for faces."""
    for pair in solid(pairs):
        if pair.ours:
            assert pair.ours.dist == pytest.approx(-pair.least, abs=2e-5), pair
            assert pair.along == pytest.approx(pair.least, abs=2e-5), pair


def test_contacts_of_hulls_agree_with_c_where_c_is_exact(pairs):
    """C stops before the least translation in some pairs, by up to 1 mm; in the others we agree."""
    both = [pair for pair in solid(pairs) if pair.ours and pair.reference]
    error = np.array([abs(pair.ours.dist - pair.reference.dist) for pair in both])
    exact = np.array([pair.reference_is_exact for pair in both])
    assert np.percentile(error, 50) < 1e-6
    assert np.percentile(error, 90) < 1e-4
    assert exact.mean() > 0.5
    assert error[exact].max() < 2e-5


def test_the_normal_is_that_of_the_least_translation_where_there_is_one(pairs):
    """Within 1 degree of the exact one, and of C's where C is exact, unless another way out is within 40 um.

    In 200 states C's normal is elsewhere in 255 of 1032 pairs: in 253 of them C is not exact (its distance is short by
    up to 0.7 mm, or moving along its normal does not part the two), the other 2 are ties.
    """
    unique = [pair for pair in solid(pairs) if pair.ours and pair.margin > UNIQUE]
    exact = [pair for pair in unique if pair.reference and pair.reference_is_exact]
    assert len(unique) > 0.7 * len(solid(pairs))
    assert len(exact) > 0.5 * len(unique)
    for pair in unique:
        assert pair.ours.normal @ pair.normal > np.cos(ALIKE), pair
    for pair in exact:
        assert pair.ours.normal @ pair.reference.normal > np.cos(ALIKE), pair


def test_contacts_mix_friction_and_softness_as_c_does(pairs):
    for pair in pairs:
        if pair.ours and pair.reference:
            np.testing.assert_allclose(pair.ours.parameters, pair.reference.parameters, rtol=1e-6)


def test_a_slot_has_the_constants_of_a_separately_filled_model(model, oracle):
    """Everything that differs between objects, with eight of them at once; the compiled median object is a decoy."""
    object_ids = np.array([16, 3, -1, 13, 5, 0, 8, 6])
    oracle.fill(object_ids, parking_poses())
    filled, hull_ids = mjx_model.fill_slots(model, jnp.asarray(object_ids))
    for names, ours, theirs in (
        (mjx_model.BODY_FIELDS, model.body_ids, oracle.slots.slot_body_ids),
        (mjx_model.DOF_FIELDS, model.dof_ids, oracle.slots.slot_dof_ids),
        (("geom_friction",), model.geom_ids, oracle.slots.slot_geom_ids),
    ):
        for name in names:
            expected = getattr(oracle.model, name)[theirs]
            np.testing.assert_allclose(getattr(filled, name)[ours], expected, rtol=1e-5, atol=1e-9, err_msg=name)
    compiled = model.mj_model.body_invweight0[model.body_ids]
    assert np.abs(filled.body_invweight0[model.body_ids] / compiled - 1).max() > 0.5
    present = np.asarray(hull_ids)[model.geom_ids] >= 0
    np.testing.assert_array_equal(present, oracle.model.geom_contype[oracle.slots.slot_geom_ids] > 0)
    robot_bodies = np.setdiff1d(np.arange(model.mj_model.nbody), model.body_ids)
    np.testing.assert_array_equal(
        filled.body_invweight0[robot_bodies], model.mj_model.body_invweight0[robot_bodies].astype(np.float32)
    )


@pytest.fixture(scope="module")
def engine(bank):
    return mjx.make_engine(bank, num_slots=NUM_SLOTS, num_hulls=MAX_HULLS)


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
    home = jnp.asarray(robot.home_joint_pos()[:6])
    ends = ((-0.2, 0.0), (-0.23, 0.01))
    rows = primitives.num_push_rows(0.1, 0.1)
    return [
        primitives.plan_push(
            home,
            jnp.asarray(robot.START_POSE[:2]),
            jnp.asarray(end),
            jnp.int32(OPEN),
            jnp.int32(CLOSED),
            push_speed=0.1,
            num_rows=rows,
        )
        for end in ends
    ]


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


def test_a_push_moves_objects_as_c_does(bank, model, oracle, engine, plans, pushed):
    """Same hulls and options: final poses near those of C after pushes that move them by 17 and 47 mm.

    How near can be asked, measured with start poses shifted at random: in the row of three, 1e-7 m (the rounding of
    float32) moves C by 3.0 to 3.6 mm, this engine by up to 6 mm, and by 0.05 mm where jax computes in float64. In the
    row of two it is C by 2 um, this engine by 0.4 mm, in float64 by 1 um. What is left in float64, 2.6 and 0.8 mm, is
    not rounding; other contacts, where C stops short of the least translation, are the suspect but not isolated.
    """
    *_, after = pushed
    seen = jax.vmap(engine.observe)(after)
    for i, object_ids in enumerate(SCENES):
        count = sum(o >= 0 for o in object_ids)
        poses = np.asarray(row_of(bank, object_ids).poses, np.float64)
        data = oracle.fill(np.array(object_ids), poses[: len(object_ids)])
        reference = oracle.push(data, np.asarray(plans[i].ctrl), int(plans[i].num_ctrl))
        moved = np.linalg.norm(reference[:count, :2] - poses[:count, :2], axis=1)
        error = np.linalg.norm(np.asarray(seen.object_poses)[i, :count, :3] - reference[:count, :3], axis=1)
        assert moved.min() > 0.01
        assert error.max() < NEAR[i], (moved, error)
        np.testing.assert_allclose(seen.joint_pos[i], data.qpos[robot.joint_qpos_ids(model.mj_model)], atol=2e-3)
    assert not seen.diverged.any()
    assert not after.pair_overflows.any()
    assert not after.contact_overflows.any()
    assert after.max_contacts.min() > 4


def test_scenes_do_not_depend_on_their_batch(plans, pushed):
    """Two sets of objects, of different number: the same bits beside any neighbour, and the same as alone.

    Alone means beside itself: a batch of one is another XLA program, of other rounding (the slow test below).
    """
    run, _, states, after = pushed
    both = stack(plans)
    for i in range(len(SCENES)):
        twice, plan = jax.tree.map(lambda x, i=i: jnp.stack([x[i]] * 2), (states, both))
        same = run(twice, plan.ctrl, plan.num_ctrl)
        np.testing.assert_array_equal(same.qpos[0], after.qpos[i])
        np.testing.assert_array_equal(same.qpos[1], after.qpos[i])


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
        again = run(after, both.ctrl, jnp.array([2, 2]))
        np.testing.assert_array_equal(again.diverged, [True, False], err_msg=name)
        np.testing.assert_array_equal(again.qpos[0], bad.qpos[0], err_msg=name)


def test_one_trace_serves_all_objects(pushed):
    """Runs last of those that use the fixture: batches of other objects and plans did not trace again."""
    assert len(pushed[1]) == 1


def test_what_is_dropped_is_counted(model):
    """A step that had more pairs or contacts than fit is counted, one at the limit is not."""
    limits = Limits(max_hull_pairs=2, max_robot_pairs=2, max_contact_points=4)
    small = dataclasses.replace(model, limits=limits)
    engine_state = mjx.MjxState(
        *(jnp.zeros(model.mj_model.nq), jnp.zeros(model.mj_model.nv), jnp.zeros(model.mj_model.nv)),
        *(jnp.full(MAX_OBJECTS, -1), jnp.array(False), *[jnp.int32(0)] * 5),
    )
    data = mujoco_mjx.make_data(model.mjx_model)
    for hulls, hand, contacts, pair_overflows, contact_overflows in ((2, 2, 4, 0, 0), (3, 0, 4, 1, 0), (0, 3, 5, 1, 1)):
        counts = ContactCounts(jnp.int32(hulls), jnp.int32(hand), jnp.int32(contacts), jnp.float32(0))
        state = mjx.guarded(small, engine_state, data, counts)
        assert (int(state.pair_overflows), int(state.contact_overflows)) == (pair_overflows, contact_overflows)
        assert (int(state.max_hull_pairs), int(state.max_contacts)) == (hulls, contacts)


def test_a_scene_with_more_objects_than_slots_is_marked(bank, engine):
    scene = row_of(bank, (0, 1, 2))
    assert not engine.observe(engine.reset(engine.init(), scene)).diverged
    fourth = dataclasses.replace(scene, object_ids=scene.object_ids.at[NUM_SLOTS].set(1))
    assert engine.observe(engine.reset(engine.init(), fourth)).diverged


@pytest.mark.slow
def test_three_thousand_steps_do_not_hang(engine, plans, pushed):
    """On two cores MJX programs deadlock unless the package has raised NPROC (9 of 9 runs hung within 103 steps)."""
    run, _, state, _ = pushed
    hold = jnp.broadcast_to(jnp.asarray(robot.home_joint_pos()[:7]), (2, *plans[0].ctrl.shape))
    rows = plans[0].ctrl.shape[0]
    steps = 0
    while steps < 3000:
        state = jax.block_until_ready(run(state, hold, jnp.array([rows, rows])))
        steps += 5 * rows
    assert not state.diverged.any()
