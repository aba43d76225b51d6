"""How the environment begins: resets, fixed scenes, and settings that cannot work."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jax.extend.core import jaxprs_in_params
from test_env import ROBOT, START, unstack

from pregrasp_jax.assets.bank import select
from pregrasp_jax.assets.catalogue import builtin_bank
from pregrasp_jax.config import Config, ExplorationConfig, SceneConfig, TaskConfig, TrainConfig
from pregrasp_jax.spaces.workspace import Box, Workspace
from pregrasp_jax.task import assembly
from pregrasp_jax.task.assembly import make_env
from pregrasp_jax.task.env import Env
from pregrasp_jax.task.place import refuse_walls
from pregrasp_jax.task.rules import make_rules
from pregrasp_jax.types import MAX_OBJECTS, SceneParams

NAMES = builtin_bank("seen").names


@pytest.fixture(scope="module")
def env() -> Env:
    return make_env(Config(scene=SceneConfig(test_scenes=3)), split="test")


@pytest.fixture(scope="module")
def choosy(env) -> Env:
    """Few objects are eligible: those that the bank names as targets, and the last, which an id of -1 would mean."""
    named = np.append(env.scenes.object_ids[np.arange(3), env.scenes.target], len(NAMES) - 1)
    return dataclasses.replace(env, eligible=np.isin(np.arange(len(NAMES)), named))


@pytest.fixture(scope="module")
def resets(choosy):
    reset, keys = jax.jit(jax.vmap(choosy.reset)), jax.random.split(jax.random.key(5), 128)
    return reset(keys), reset(keys)


def assert_turned(scenes, scene: SceneParams, index: int, yaw: float) -> None:
    """Every object of `scene` is the bank's, turned about the centre; empty slots are where they were."""
    turn, expected = np.zeros(4), scenes.poses[index].astype(np.float64)
    mujoco.mju_axisAngle2Quat(turn, [0, 0, 1], yaw)
    for row in np.flatnonzero(scenes.object_ids[index] >= 0):
        position, quat = np.zeros(3), np.zeros(4)
        mujoco.mju_rotVecQuat(position, expected[row, :3], turn)
        mujoco.mju_mulQuat(quat, turn, expected[row, 3:])
        expected[row] = [*position, *quat]
    np.testing.assert_array_equal(scene.object_ids, scenes.object_ids[index])
    np.testing.assert_allclose(scene.poses, expected, atol=2e-6)


def test_reset_draws_scene_yaw_and_eligible_target(choosy, resets):
    scenes, yaws, targets = choosy.scenes, [], set()
    for state in unstack(resets[0], range(128)).values():
        index, scene = int(state.scene_index), state.scene
        far = np.argmax(np.linalg.norm(scenes.poses[index, :, :2], axis=1) * (scenes.object_ids[index] >= 0))
        yaws.append(np.angle(complex(*scene.poses[far, :2]) / complex(*scenes.poses[index, far, :2])))
        assert_turned(scenes, scene, index, yaws[-1])
        np.testing.assert_array_equal(state.physics_obs.object_poses, scene.poses)
        targets.add((index, int(scene.target)))
    eligible = (scenes.object_ids >= 0) & choosy.eligible[scenes.object_ids]
    assert targets == {(int(i), int(j)) for i, j in np.argwhere(eligible)}, "every eligible target, and no other"
    assert (scenes.object_ids < 0).any()
    assert set(np.floor(np.array(yaws) / (np.pi / 4))) == set(range(-4, 4)), "yaws are drawn from the whole circle"


def test_tight_targets_are_drawn_as_often_as_they_weigh(env):
    """Of the built-in seen objects three fit at some yaws only; nothing but the training's resets draws by weights."""
    config = Config(scene=SceneConfig(train_scenes=3, test_scenes=3), train=TrainConfig(tight_targets=5.0))
    weighed = make_env(config, split="train")
    weights = weighed.target_weights
    assert weights is not None and make_env(config, split="test").target_weights is None
    tight = [name for name, weight in zip(NAMES, weights, strict=True) if 1.01 < weight < 4.99]
    assert tight == ["ycb_mug_tall", "ycb_wood_block", "ycb_bleach_cleanser"]
    ids = np.array([NAMES.index(name) for name in ("ycb_pitcher", "ycb_wood_block", "kit_jam_jar", *tight[:1])])
    ids = jnp.asarray(np.append(ids, np.full(MAX_OBJECTS - len(ids), -1)), jnp.int32)
    keys = jax.random.split(jax.random.key(3), 4000)
    drawn = np.bincount(jax.jit(jax.vmap(weighed.draw_target, (0, None)))(keys, ids), minlength=MAX_OBJECTS) / 4000
    wanted = weights[ids] * weighed.eligible[ids] * (np.asarray(ids) >= 0)
    np.testing.assert_allclose(drawn, wanted / wanted.sum(), atol=0.03)
    assert drawn[0] == 0, "a pitcher is no target, whatever it weighs"
    even = np.bincount(jax.jit(jax.vmap(env.draw_target, (0, None)))(keys, ids), minlength=MAX_OBJECTS) / 4000
    np.testing.assert_allclose(even[1:4], 1 / 3, atol=0.03)


def test_a_hand_without_a_closing_region_has_no_tight_targets(env):
    handless = dataclasses.replace(env, robot=dataclasses.replace(env.robot, closing_region=None))
    with pytest.raises(
        ValueError, match=r"tight_targets = 5: the hand of robot ur5e_rg2 has no closing region; allowed"
    ):
        assembly._target_weights(handless, 5.0)


def test_reset_is_a_function_of_its_key(resets):
    jax.tree.map(np.testing.assert_array_equal, *resets)
    assert len({poses.tobytes() for poses in np.asarray(resets[0].scene.poses)}) == 128


def test_a_started_scene_shows_every_object_to_an_open_hand_at_the_start(env):
    states = unstack(jax.jit(jax.vmap(env.reset_to))(jnp.arange(3)), range(3))
    for index, state in states.items():
        assert_turned(env.scenes, state.scene, index, float(env.scenes.yaw[index]))
        assert state.scene.target == env.scenes.target[index] and state.scene_index == index
        np.testing.assert_allclose(state.hand.xy, START, atol=1e-7)
        np.testing.assert_allclose(state.physics_obs.hand_pose, [*START, 0.1, 1, 0, 0, 0], atol=1e-5)
        assert state.hand.aperture == ROBOT.start.aperture and state.num_pushes == 0
        present = {slot + 1 for slot in range(MAX_OBJECTS) if state.scene.object_ids[slot] >= 0}
        assert set(np.unique(state.obs.instance_ids)) == {0} | present, "the fingers end 19 mm before the workspace"
        for slot in present:
            x, y = np.nonzero(state.obs.instance_ids == slot)[::-1]
            centre = -0.25 + 0.005 * (np.array([x.mean(), y.mean()]) + 0.5)
            np.testing.assert_allclose(centre, state.scene.poses[slot - 1, :2], atol=0.02)


@pytest.mark.parametrize(("guided", "longest"), [(True, 0.2), (False, np.hypot(0.5, 0.5))])
def test_pushes_are_planned_as_long_as_exploration_needs_them(guided, longest):
    config = Config(scene=SceneConfig(test_scenes=3), exploration=ExplorationConfig(guided=guided))
    assert longest <= make_env(config, split="test").max_distance < longest + 0.2


def test_nothing_that_is_measured_is_multiplied_in_less_than_float32(env):
    """Accelerators do so by default; it moves a point by tenths of a millimetre. The CPU would not show it."""
    state = jax.eval_shape(env.reset, jax.random.key(0))
    programs = [jax.make_jaxpr(env.reset)(jax.random.key(0)), jax.make_jaxpr(env.step)(state, jnp.int32(0))]
    programs.append(jax.make_jaxpr(env.grasp)(state))
    products = [eqn for program in programs for eqn in equations(program.jaxpr) if eqn.primitive.name == "dot_general"]
    assert len(products) > 5
    for product in products:
        assert product.params["precision"] == (jax.lax.Precision.HIGHEST,) * 2, product.source_info


def equations(jaxpr: Any) -> Iterator[Any]:
    """Yield the equations of a program, of those that it calls too."""
    for eqn in jaxpr.eqns:
        yield eqn
        for inner in jaxprs_in_params(eqn.params):
            yield from equations(inner)


def test_settings_that_cannot_work_are_refused(monkeypatch):
    with pytest.raises(ValueError, match=r"task\.r_out = 0\.05 leave no cell .*; allowed is a ring"):
        make_env(Config(scene=SceneConfig(test_scenes=3), task=TaskConfig(r_out=0.05)), split="test")
    make_env(Config(scene=SceneConfig(test_scenes=3), task=TaskConfig(r_out=0.06)), split="test")
    monkeypatch.setattr(assembly.scene_bank, "load_or_build", lambda *_, **__: pytest.fail("packed too early"))
    for field, allowed in (("workspace", "table"), ("robot", "ur5e_rg2"), ("primitive", "push")):
        task = dataclasses.replace(TaskConfig(), **{field: "nowhere"})  # pyright: ignore[reportArgumentType]
        with pytest.raises(ValueError, match=rf"task\.{field} = 'nowhere' does not exist; allowed: .*{allowed}"):
            make_env(Config(task=task), split="test")


@pytest.mark.parametrize(
    ("wall", "said"),
    [
        (
            Box(center=(0.3, 0.0, 0.1), half_size=(0.1, 0.4, 0.1)),
            r"wall 1 comes within 0\.200 m .* is 0\.245",
        ),
        (
            Box(center=(-0.5, 0.0, 0.3), half_size=(0.01, 0.4, 0.3)),
            r"robot .* is -?0\.\d+ m from wall 1 or the table; allowed is 0\.015",
        ),
    ],
)
def test_walls_in_the_way_are_refused(wall, said):
    fine = Box(center=(0.0, 0.6, 0.1), half_size=(0.4, 0.02, 0.1))
    refuse_walls(ROBOT, Workspace(name="room", walls=(fine,)))
    with pytest.raises(ValueError, match=rf"workspace 'room': {said} m or more"):
        refuse_walls(ROBOT, Workspace(name="room", walls=(fine, wall)))


def test_objects_that_no_hand_can_take_are_refused():
    bank = builtin_bank("seen")
    wide = [i for i, why in enumerate(ROBOT.eligibility(bank).reasons) if why]
    with pytest.raises(ValueError, match=rf"none of {len(wide)} objects .* robot ur5e_rg2; .* best coverage"):
        assembly.eligible_targets(ROBOT, select(bank, wide))


def test_a_robot_without_a_closing_region_has_no_such_rules(env):
    handless = dataclasses.replace(ROBOT, closing_region=None)
    with pytest.raises(ValueError, match="robot ur5e_rg2 has no closing region; allowed for primitive push"):
        make_rules(handless, env.workspace, env.primitive, env.bank, env.task)
