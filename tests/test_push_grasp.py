"""A stroke stops where the hand comes down on something, holds what it encloses, and carries it away."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pregrasp_jax.assets.bank import select
from pregrasp_jax.assets.sets import builtin_bank
from pregrasp_jax.config import TaskConfig
from pregrasp_jax.physics import make_engine
from pregrasp_jax.physics.base import MAX_PENETRATION
from pregrasp_jax.physics.native import from_bits
from pregrasp_jax.robot import get_robot
from pregrasp_jax.scene.model import parking_poses
from pregrasp_jax.spaces.workspace import TABLE
from pregrasp_jax.task import push_grasp, registry
from pregrasp_jax.task.push_grasp import plan_stroke, stroke_actions
from pregrasp_jax.task.stroke_rules import stable
from pregrasp_jax.types import MAX_OBJECTS, SceneParams

KIND = registry.get_kind("push_grasp")


@pytest.fixture(scope="module")
def robot():
    return get_robot("barrett")


@pytest.fixture(scope="module")
def bank():
    bank = builtin_bank("seen")
    return select(bank, [bank.names.index(name) for name in ("ycb_mustard_bottle", "ycb_chips_can")])


@pytest.fixture(scope="module")
def engine(bank, robot):
    return make_engine("native", bank, robot, TABLE, threads=1, engines=KIND.engines)


def scene(*places):
    """Return objects 0 at places (x, y), standing."""
    ids, poses = np.full(MAX_OBJECTS, -1), parking_poses()
    for slot, (x, y) in enumerate(places):
        ids[slot], poses[slot] = 0, [x, y, 0, 1, 0, 0, 0]
    return SceneParams(jnp.asarray(ids), jnp.asarray(poses, jnp.float32), jnp.int32(0))


@pytest.fixture(scope="module")
def attempt(engine, robot):
    """(scenes, aperture) -> states after a stroke from (-0.15, 0) to the origin in each of them."""

    def one(scene, aperture):
        stroke = push_grasp.push_grasp(jnp.array([-0.15, 0.0]), 0.0, aperture)
        plan = plan_stroke(robot, TABLE, stroke, push_speed=0.1, hold_time=0.5)
        return engine.run(engine.reset(engine.init(), scene), plan.ctrl, plan.num_ctrl)

    run = jax.jit(jax.vmap(one, (0, None)))
    return lambda *scenes: run(jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenes), jnp.float32(0.7))


@pytest.fixture(scope="module")
def states(attempt):
    """After strokes at: one object ahead, two ahead, one under the palm, one far away."""
    return attempt(scene((0.02, 0.0)), scene((0.0, 0.045), (0.0, -0.045)), scene((-0.18, 0.0)), scene((0.0, 0.2)))


def pick(states, index):
    return jax.tree.map(lambda leaf: leaf[index], states)


def tips(robot):
    return np.isin(robot.links.names, robot.fingertips)


def test_one_object_ahead_is_held_stably_and_carried_away(states, engine, robot):
    state = pick(states, 0)
    touch = state.touch
    assert not touch.collided and stable(touch, tips(robot)).tolist() == [True] + [False] * 7
    assert touch.poses[0, 0, 0] == pytest.approx(0.02, abs=1e-3) and touch.poses[1, 0, 0] > 0.02
    assert touch.poses[2, 0, 2] == pytest.approx(0.3, abs=0.03)
    assert touch.gone.tolist() == [True] + [False] * 7 and state.native.object_ids[0] == -1
    np.testing.assert_allclose(state.native.object_poses, parking_poses(), atol=1e-5)
    np.testing.assert_allclose(engine.observe(state).hand_pose[:3], [*robot.start.xy, robot.start.z], atol=1e-5)


def test_two_objects_are_lifted_and_neither_counts_as_stable(states, robot):
    touch = pick(states, 1).touch
    assert (touch.poses[2, :2, 2] > push_grasp.LIFTED).all() and touch.gone[:2].all()
    assert not stable(touch, tips(robot)).any()


def test_a_hand_that_comes_down_on_an_object_stops_at_once(states):
    state = pick(states, 2)
    touch = state.touch
    # The bottle is 0.19 m tall and the hand's lowest part 0.055 m above the table at the end of a way of 0.3 m.
    assert touch.collided and 20 < touch.rows < 50
    assert not touch.gone.any() and not touch.contacts.any()
    np.testing.assert_allclose(state.native.object_poses[0, :2], [-0.18, 0.0], atol=5e-3)


def test_an_object_that_slips_from_a_lifted_hand_has_not_diverged(engine, robot, monkeypatch):
    can = scene((0.0, 0.2)).replace(object_ids=scene((0.0, 0.2)).object_ids.at[0].set(1))
    tilts = np.linspace(0.0, 0.5, 6)  # on an edge it sinks in deeper than on its base
    poses = [jnp.array([0.0, 0.2, 0.29, np.cos(tilt), np.sin(tilt), 0.0, 0.0]) for tilt in tilts]
    falling = [can.replace(poses=can.poses.at[0].set(pose)) for pose in poses]
    states = [engine.reset(engine.init(), s).native for s in falling]
    bits, ids = (np.stack([np.asarray(getattr(state, name)) for state in states]) for name in ("bits", "object_ids"))
    ctrl = np.tile(robot.home, (len(tilts), 20, 1))
    simulations = engine.advance.__self__.simulations

    def diverged():
        return simulations.run(from_bits(bits).copy(), ids, ctrl, np.full(len(tilts), 20))[1]

    assert not diverged().any()
    monkeypatch.setattr(simulations, "max_penetration", MAX_PENETRATION)
    assert diverged().any(), "the limit of pushes, where nothing falls"


def test_what_stands_beside_stays(states):
    state = pick(states, 3)
    assert not state.touch.collided and not state.touch.gone.any() and not state.touch.contacts.any()
    np.testing.assert_allclose(state.native.object_poses[0, :3], [0.0, 0.2, 0.0], atol=1e-3)
    assert state.native.object_ids.tolist() == [0] + [-1] * 7


def test_a_scene_ends_the_same_whatever_is_beside_it(attempt, states):
    alone = attempt(scene((0.02, 0.0)), scene((-0.18, 0.0)), scene((0.02, 0.0)), scene((-0.18, 0.0)))
    for found, expected in ((0, 0), (1, 2), (2, 0)):
        for a, b in zip(*(jax.tree.leaves(pick(s, i)) for s, i in ((alone, found), (states, expected))), strict=True):
            np.testing.assert_array_equal(a, b)


def test_nothing_happens_where_nothing_may_be_executed(engine, robot):
    stroke = push_grasp.push_grasp(jnp.array([-0.15, 0.0]), 0.0, 0.7)
    planned = jax.jit(functools.partial(plan_stroke, robot, TABLE, push_speed=0.1, hold_time=0.5))(stroke)
    plan = planned.unless(jnp.bool_(True), "no_ik")
    before = engine.reset(engine.init(), scene((0.02, 0.0)))
    after = engine.advance(*jax.tree.map(lambda leaf: leaf[None], (before, plan.ctrl, plan.num_ctrl)))
    for a, b in zip(jax.tree.leaves(after), jax.tree.leaves(before), strict=True):
        np.testing.assert_array_equal(a[0], b)
    jax.tree.map(np.testing.assert_array_equal, plan.stroke, stroke)


def test_a_stroke_beyond_the_reach_is_not_executed(robot):
    far = push_grasp.push_grasp(jnp.array([0.30, 0.0]), 0.0, 0.7)
    plan = plan_stroke(robot, TABLE, far, push_speed=0.1, hold_time=0.5)
    assert not plan.reachable and plan.num_ctrl == 0


def test_an_index_is_a_cell_a_heading_and_the_middle_aperture(robot, bank):
    primitive = KIND.make_primitive(robot, TABLE, TaskConfig(), max_distance=0.2)
    actions = stroke_actions()
    stroke = primitive.normal(actions.encode(jnp.int32(10), jnp.int32(20), jnp.int32(4)))
    np.testing.assert_allclose(stroke.start.xy, [-0.1475, -0.1975], atol=1e-6)
    np.testing.assert_allclose(stroke.end.xy, [-0.1475, -0.0475], atol=1e-6)
    assert stroke.start.aperture == pytest.approx(0.85) and primitive.choice(stroke) == 4 and not stroke.final
    assert primitive.normal(stroke) is stroke
    mirrored = [primitive.choice(primitive.normal(actions.mirror(jnp.int32(k)))) for k in (0, 1, 4, 15)]
    assert mirrored == [0, 15, 12, 1]


def test_refusals(bank, robot):
    arm = get_robot("ur5e_rg2")
    with pytest.raises(ValueError, match="robot ur5e_rg2 cannot come from above; allowed is a hand that floats"):
        make_engine("native", bank, arm, TABLE, engines=KIND.engines)
    with pytest.raises(ValueError, match=r"physics\.engine = 'mjx' cannot do this task; allowed: native$"):
        make_engine("mjx", bank, robot, TABLE, engines=KIND.engines)
    with pytest.raises(ValueError, match=r"aperture = 1\.3 rad is out of range; allowed is 0\.6 to 1\.1$"):
        push_grasp.push_grasp(jnp.zeros(2), 0.0, 1.3)
    without = dataclasses.replace(robot, fingertips=())
    with pytest.raises(ValueError, match="robot barrett names no fingertips"):
        KIND.make_rules(without, TABLE, None, bank, TaskConfig())
