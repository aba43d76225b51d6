import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pregrasp_jax.assets.catalogue import builtin_bank
from pregrasp_jax.config import SceneConfig
from pregrasp_jax.physics import make_engine
from pregrasp_jax.physics.base import Engine
from pregrasp_jax.physics.native import widen_bits
from pregrasp_jax.robot import get_robot
from pregrasp_jax.robot.ur5e_rg2 import FINGER_OPEN
from pregrasp_jax.scene import bank as scene_bank
from pregrasp_jax.scene.model import parking_poses
from pregrasp_jax.spaces.motion import minimum_jerk
from pregrasp_jax.spaces.workspace import TABLE
from pregrasp_jax.task.primitive import Stroke
from pregrasp_jax.task.push import num_push_rows, plan_push
from pregrasp_jax.types import CTRL_DT, SceneParams

ROBOT = get_robot("ur5e_rg2")
START, PUSH_HEIGHT = (-0.30, 0.0), 0.1

ENDS = ((-0.2, 0.0), (-0.25, 0.1), (-0.15, 0.0))
NUM_ROWS = num_push_rows(0.15, 0.1)


@pytest.fixture(scope="module")
def engine() -> Engine:
    made = make_engine("native", builtin_bank("seen"), ROBOT, TABLE)
    return dataclasses.replace(made, init=jax.jit(made.init), reset=jax.jit(made.reset), observe=jax.jit(made.observe))


@pytest.fixture(scope="module")
def scenes():
    config = SceneConfig(test_scenes=3)
    bank = builtin_bank("seen")
    return scene_bank.load_or_build(bank, ROBOT.eligibility(bank).eligible, config, "test")


def empty_scene() -> SceneParams:
    return SceneParams(jnp.full(8, -1), jnp.asarray(parking_poses(), jnp.float32), jnp.int32(0))


def packed_scene(scenes, index) -> SceneParams:
    return SceneParams(
        jnp.asarray(scenes.object_ids[index]), jnp.asarray(scenes.poses[index]), jnp.asarray(scenes.target[index])
    )


@jax.jit
def plan(joints, start, end):
    hand = jax.tree.map(jnp.asarray, ROBOT.start)
    stroke = Stroke(hand.replace(xy=jnp.asarray(start)), hand.replace(xy=jnp.asarray(end)))
    return plan_push(ROBOT, TABLE, joints, stroke, push_speed=0.1, num_rows=NUM_ROWS)


def push(engine, state, start, end, num_ctrl=None):
    planned = plan(engine.observe(state).joint_pos, start, end)
    return engine.run(state, planned.ctrl, planned.num_ctrl if num_ctrl is None else num_ctrl)


def test_reset_puts_everything_where_the_scene_says(engine, scenes):
    scene = packed_scene(scenes, 0)
    seen = engine.observe(engine.reset(engine.init(), scene))
    np.testing.assert_array_equal(seen.object_poses, scene.poses)
    np.testing.assert_allclose(seen.hand_pose, [*START, PUSH_HEIGHT, 1, 0, 0, 0], atol=1e-5)
    np.testing.assert_allclose(seen.joint_pos[6:], FINGER_OPEN, atol=1e-6)
    assert not seen.diverged


@pytest.mark.parametrize("end", [(-0.15, 0.0), (-0.3, 0.15), (-0.25, -0.1)])
def test_a_free_push_ends_where_it_should(engine, end):
    state = engine.reset(engine.init(), empty_scene())
    state = jax.jit(lambda s: push(engine, s, START, end))(state)
    hand = engine.observe(state).hand_pose
    np.testing.assert_allclose(hand[:3], [*end, PUSH_HEIGHT], atol=5e-4)


def test_a_free_push_stays_on_its_line(engine):
    start, end = np.array(START), np.array([-0.2, 0.1])
    direction = (end - start) / np.linalg.norm(end - start)
    for num_ctrl in (20, 35, 50):
        state = engine.reset(engine.init(), empty_scene())
        hand = engine.observe(push(engine, state, start, end, jnp.int32(num_ctrl))).hand_pose[:2] - start
        assert abs(float(np.cross(np.append(direction, 0), np.append(hand, 0))[2])) < 2e-3
        planned = 0.1414 * float(minimum_jerk(jnp.float32(num_ctrl * CTRL_DT / 1.414)))
        assert abs(float(np.dot(direction, hand)) - planned) < 4e-3


def test_a_push_moves_objects_and_batching_changes_nothing(engine, scenes):
    nearer = jnp.array([-0.08, 0, 0, 0, 0, 0, 0])
    packed = [packed_scene(scenes, i) for i in range(3)]
    packed = [scene.replace(poses=scene.poses + nearer[None]) for scene in packed]
    plans = [plan(jnp.asarray(ROBOT.home), START, end) for end in ENDS]

    def run(scene, plan):
        return engine.run(engine.reset(engine.init(), scene), plan.ctrl, plan.num_ctrl)

    alone = [jax.jit(run)(*arguments) for arguments in zip(packed, plans, strict=True)]
    together = jax.jit(jax.vmap(run))(*(jax.tree.map(lambda *x: jnp.stack(x), *each) for each in (packed, plans)))
    for i in range(3):
        np.testing.assert_array_equal(together.bits[i], alone[i].bits)
    moved = np.abs(np.asarray(together.object_poses) - np.stack([p.poses for p in packed]))[..., :2].max(axis=(1, 2))
    assert moved.max() > 0.01


def test_zero_rows_change_nothing(engine, scenes):
    state = engine.reset(engine.init(), packed_scene(scenes, 0))
    after = push(engine, state, START, (-0.2, 0.0), jnp.int32(0))
    np.testing.assert_array_equal(state.bits, after.bits)


def test_a_diverged_scene_is_reported_alone_and_stays_diverged(engine, scenes, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scene = packed_scene(scenes, 0)
    bad = dataclasses.replace(scene, poses=scene.poses.at[0, 2].set(jnp.nan))
    both = jax.tree.map(lambda *x: jnp.stack(x), bad, scene)

    def run(scene):
        return push(engine, engine.reset(engine.init(), scene), START, (-0.25, 0.0))

    state = jax.jit(jax.vmap(run))(both)
    np.testing.assert_array_equal(state.diverged, [True, False])
    assert not list(tmp_path.iterdir()), "MuJoCo must not leave a log file behind"
    again = jax.jit(jax.vmap(lambda s: push(engine, s, START, (-0.25, 0.0))))(state)
    np.testing.assert_array_equal(again.diverged, [True, False])


def test_how_a_scene_diverges_does_not_depend_on_when_others_are_through(engine, scenes):
    """The host runs the rows up to where the first scene is through, then the rest."""
    scene = packed_scene(scenes, 0)
    sick = engine.reset(engine.init(), dataclasses.replace(scene, poses=scene.poses.at[0, 0].set(jnp.nan)))
    planned = plan(jnp.asarray(ROBOT.home), START, (-0.25, 0.0))
    alone = engine.run(sick, planned.ctrl, jnp.int32(20))
    both = jax.tree.map(lambda *x: jnp.stack(x), sick, engine.reset(engine.init(), scene))
    beside = jax.vmap(lambda state, rows: engine.run(state, planned.ctrl, rows))(both, jnp.array([20, 3]))
    np.testing.assert_array_equal(beside.bits[0], alone.bits)
    np.testing.assert_array_equal(beside.diverged, [True, False])


def test_too_deep_and_too_fast_end_a_scene_and_nothing_else_does(engine, scenes):
    """15 mm deep in the table is not too deep, and what is too deep counts though it is pressed out at once."""
    states = [engine.reset(engine.init(), packed_scene(scenes, 0)) for _ in range(5)]
    wanted = {"shallow": False, "in the table": True, "in each other": True, "fast": True, "healthy": False}
    for index, name in enumerate(wanted):
        qpos, qvel = (np.array(x) for x in engine.coordinates(states[index]))
        first, second = 10, 17  # the arm and the fingers have ten
        if "table" in name or name == "shallow":
            qpos[first + 2] -= 0.06 if name == "in the table" else 0.015
        if name == "in each other":
            qpos[first : first + 3] = qpos[second : second + 3]
        if name == "fast":
            qvel[-1] = 150.0
        states[index] = engine.place(states[index].object_ids, jnp.asarray(qpos), jnp.asarray(qvel))
    batch = jax.tree.map(lambda *x: jnp.stack(x), *states)
    planned = plan(jnp.asarray(ROBOT.home), START, (-0.25, 0.0))
    run = jax.jit(jax.vmap(lambda state: engine.run(state, planned.ctrl, jnp.int32(2))))
    after = run(batch)
    np.testing.assert_array_equal(after.diverged, list(wanted.values()))
    moved = np.abs(np.asarray(after.object_poses - batch.object_poses))[2, :2, :3].max()
    assert moved < 1, "it was too deep, and neither fast nor infinite"
    np.testing.assert_array_equal(run(after).diverged, list(wanted.values()))


def test_coordinates_put_a_scene_into_the_same_place(engine, scenes):
    packed = jax.tree.map(lambda *x: jnp.stack(x), packed_scene(scenes, 0), packed_scene(scenes, 1))
    states = jax.jit(jax.vmap(lambda scene: push(engine, engine.reset(engine.init(), scene), START, ENDS[1])))(packed)
    look = jax.jit(jax.vmap(lambda s: (engine.observe(s), engine.coordinates(s))))
    again = jax.jit(jax.vmap(lambda s: engine.place(s.object_ids, *engine.coordinates(s))))(states)
    for old, new in zip(*(jax.tree.leaves(look(s)) for s in (states, again)), strict=True):
        np.testing.assert_array_equal(old, new)
    assert look(states)[1][1].shape == (2, 58)


def test_an_unknown_engine_is_refused():
    with pytest.raises(ValueError, match=r"physics.engine = 'bullet' .* allowed: native"):
        make_engine("bullet", builtin_bank("seen"), ROBOT, TABLE)


def test_float32_is_widened_to_the_bits_of_float64():
    rng = np.random.default_rng(0)
    limits = np.finfo(np.float32)
    special = [0.0, -0.0, 1.0, -1.0, np.inf, -np.inf, limits.max, limits.min, limits.tiny, -limits.tiny, 1 / 3, np.pi]
    anything = rng.integers(0, 2**32, 20_000, dtype=np.uint32).view(np.float32)
    normal = anything[np.isfinite(anything) & (np.abs(anything) >= limits.tiny)]
    assert len(normal) > 15_000 and len(np.unique(np.frexp(normal)[1])) > 240, "of every exponent"
    values = np.concatenate([np.array(special, np.float32), normal])
    for compiled in (False, True):
        bits = np.asarray((jax.jit(widen_bits) if compiled else widen_bits)(jnp.asarray(values)))
        np.testing.assert_array_equal(bits, values.astype(np.float64).view(np.uint32).reshape(-1, 2))
    nan = np.ascontiguousarray(widen_bits(jnp.array([jnp.nan, -jnp.nan]))).view(np.float64)
    assert np.isnan(nan).all()
    subnormal = np.array([limits.smallest_subnormal, -limits.tiny / 2], np.float32)
    found = np.ascontiguousarray(widen_bits(jnp.asarray(subnormal))).view(np.float64)
    np.testing.assert_array_equal(found.ravel(), [0.0, 0.0])


def test_controls_of_another_robot_are_refused(engine):
    with pytest.raises(ValueError, match="ctrl must have 7 columns for robot ur5e_rg2, got 6"):
        engine.run(engine.init(), jnp.zeros((3, 6)), jnp.int32(3))


def test_a_scene_may_start_in_the_mirror_image_of_the_arm(engine, scenes):
    """Under `vmap`, beside one that does not; in it the arm can push as well."""
    scene = packed_scene(scenes, 0)
    starts = jax.jit(jax.vmap(lambda mirrored: engine.reset(engine.init(), scene, mirrored)))(jnp.array([False, True]))
    seen = jax.vmap(engine.observe)(starts)
    np.testing.assert_allclose(seen.joint_pos, ROBOT.homes, atol=1e-6)
    np.testing.assert_array_equal(seen.object_poses[1], scene.poses)
    np.testing.assert_allclose(seen.hand_pose[1], seen.hand_pose[0], atol=1e-5)
    empty = engine.reset(engine.init(), empty_scene(), True)
    hand = engine.observe(jax.jit(lambda s: push(engine, s, START, (-0.15, 0.0)))(empty)).hand_pose
    np.testing.assert_allclose(hand[:3], [-0.15, 0.0, PUSH_HEIGHT], atol=5e-4)
