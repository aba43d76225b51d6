"""Training and evaluation on the `mjx` engine: real pushes of two scenes, one program for a whole iteration."""

import dataclasses
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fake_env import ACTIONS
from fake_training import TinyNetwork, input_fn

from pregrasp_jax.assets.catalogue import builtin_bank
from pregrasp_jax.config import Config, SceneConfig
from pregrasp_jax.evaluation import Evaluator
from pregrasp_jax.learning.q_function import QFunction
from pregrasp_jax.physics import mjx, native
from pregrasp_jax.physics.base import Engine
from pregrasp_jax.policies import scripts
from pregrasp_jax.presets import PRESETS
from pregrasp_jax.robot import get_robot
from pregrasp_jax.scene import bank as scene_bank
from pregrasp_jax.scene.model import parking_poses
from pregrasp_jax.spaces.workspace import TABLE
from pregrasp_jax.task.assembly import assemble
from pregrasp_jax.task.env import Env
from pregrasp_jax.training import program
from pregrasp_jax.training.mishap import NONE
from pregrasp_jax.types import MAX_OBJECTS, REASONS, SceneParams

ROBOT = get_robot("ur5e_rg2")
ROOT = Path(__file__).parent.parent
NUM_SLOTS = 3
SUCCESSES = (REASONS.index("target_in_region"),)
FEW = SceneConfig(min_objects=2, max_objects=NUM_SLOTS, train_scenes=4)


class Built(NamedTuple):
    """A training that is not compiled yet, and a note of every trace of a push."""

    program: program.Program
    traces: list[int]


class Training(NamedTuple):
    """A compiled iteration and the state before and after two."""

    iterate: Any
    pace: Any
    before: program.TrainState
    after: program.TrainState


def make_env(num_slots: int, scenes: SceneConfig, traces: list[int] | None = None, engine: Engine | None = None) -> Env:
    """Return the environment of the ci preset on packed scenes, on MJX; `traces` notes every trace of a push."""
    bank = builtin_bank("seen")
    engine = engine or mjx.make_engine(bank, ROBOT, TABLE, num_slots=num_slots)

    def counted(state, ctrl, num_ctrl):
        if traces is not None:
            traces.append(1)
        return engine.run(state, ctrl, num_ctrl)

    packed = scene_bank.load_or_build(bank, ROBOT.eligibility(bank).eligible, scenes, "train")
    return dataclasses.replace(assemble(Config(), bank, packed), engine=dataclasses.replace(engine, run=counted))


def make_program(env: Env) -> program.Program:
    """Return the program of the ci preset, two iterations in one."""
    q_function = QFunction(TinyNetwork(), ACTIONS, input_fn)  # what is compiled here is long enough without a real one
    config = dataclasses.replace(PRESETS["ci"], train=dataclasses.replace(PRESETS["ci"].train, fused_iterations=2))
    return program.make_program(env, config, q_function=q_function)


def host_calls(built: program.Program, *platforms: str) -> list[str]:
    """Return what the iterations of a program call on the host when they are lowered for all of some platforms."""
    # Without weak types, as `compile` does: the trace of a push is then that of `shapes`.
    state = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), built.shapes())
    due = (jax.ShapeDtypeStruct((2,), dtype) for dtype in (jnp.int32, jnp.float32))
    traced = jax.jit(program.make_iterate(built), donate_argnums=0).trace(state, *due, built.pace)
    text = traced.lower(lowering_platforms=platforms).as_text()
    assert len(re.findall(r"stablehlo\.while", text)) > 1, "the loops over iterations and physics steps are in it"
    return re.findall(r"custom_call @\w*callback\w*|stablehlo\.(?:send|recv)\b", text)


@pytest.fixture(scope="module")
def built() -> Built:
    traces = []
    return Built(make_program(make_env(NUM_SLOTS, FEW, traces)), traces)


@pytest.mark.slow
def test_the_iteration_stays_on_an_accelerator(built):
    assert host_calls(built.program, "cuda", "tpu") == []


def test_with_the_native_engine_it_does_not():
    """So the test above can fail. JAX refuses to lower a callback for a platform that this machine does not have."""
    engine = native.make_engine(builtin_bank("seen"), ROBOT, TABLE)
    assert host_calls(make_program(make_env(NUM_SLOTS, FEW, engine=engine)), "cpu")


@pytest.fixture(scope="module")
def training(built) -> Training:
    before, pace = jax.jit(built.program.init)(jax.random.key(0)), built.program.pace
    iterate = built.program.compile(before).iterate
    assert iterate is not None
    donated = jax.tree.map(jnp.copy, before)
    after = iterate(donated, np.array([0, 2], np.int32), np.full(2, 0.4, np.float32), pace)
    assert donated.actors.env_states.physics.qpos.is_deleted()
    assert donated.learning.replay.observations.height.is_deleted()
    return Training(iterate, pace, before, after)


@pytest.mark.slow
def test_two_iterations_push_remember_and_update(training):
    before, after = training.before, training.after
    report = after.actors.tally.metrics(SUCCESSES)
    assert report["env_steps"] == 4 and report["physics/overflows"] == 0 and report["reasons/nan"] == 0
    assert int(after.learning.learner.gradient_steps) == 2
    assert np.isfinite(after.learning.metrics["train/loss"])
    assert after.learning.replay.num_alive > 0
    old, new = (state.learning.learner.params for state in (before, after))
    assert any((a != b).any() for a, b in zip(jax.tree.leaves(old), jax.tree.leaves(new), strict=True))
    states = after.actors.env_states
    assert np.isfinite(states.physics.qpos).all() and (states.physics.max_contacts > 0).any()


@pytest.mark.slow
def test_a_scene_that_diverges_ends_alone_is_counted_and_starts_anew(training):
    """The other scene does what it does beside a neighbour in good health."""
    states = training.before.actors.env_states
    broken = states.replace(physics=states.physics.replace(qpos=states.physics.qpos.at[0, -1].set(jnp.nan)))
    state = training.before.replace(actors=training.before.actors.replace(env_states=broken))
    idle = np.zeros(2, np.int32), np.zeros(2, np.float32), training.pace
    after = training.iterate(jax.tree.map(jnp.copy, state), *idle)
    report = after.actors.tally.metrics(SUCCESSES)
    assert report["reasons/nan"] == 1 and report["physics/diverged"] == 1 and report["episodes"] >= 1
    kept, before = after.actors.mishap, state.actors.env_states.physics
    assert (int(kept.scene), int(kept.branch), int(kept.env_steps)) == (0, 0, 2) and bool(kept.seen.diverged)
    np.testing.assert_array_equal(kept.state.physics.qpos, before.qpos[0])
    assert int(training.after.actors.mishap.action) == NONE
    recovered, healthy = after.actors.env_states, training.after.actors.env_states
    assert np.isfinite(recovered.physics.qpos).all() and not recovered.physics.diverged.any()
    assert recovered.num_pushes[0] == 1, "it ended in the first iteration and was pushed anew in the second"
    first = training.after.learning.replay.observations.height[1]
    np.testing.assert_array_equal(after.learning.replay.observations.height[1], first)
    assert healthy.num_pushes[1] == recovered.num_pushes[1]


@pytest.mark.slow
def test_a_push_is_traced_once(built, training):
    """For shapes, start and compilation, whatever objects the scenes then have."""
    assert len(built.traces) == 1


@pytest.fixture(scope="module")
def full_env() -> Env:
    return make_env(MAX_OBJECTS, SceneConfig(train_scenes=8))


@pytest.mark.slow
def test_twenty_pushes_on_four_packed_scenes_with_automatic_resets(full_env):
    config = dataclasses.replace(PRESETS["ci"], train=dataclasses.replace(PRESETS["ci"].train, num_envs=4))
    built = program.make_program(full_env, config)
    state = jax.jit(built.init)(jax.random.key(0))
    push = jax.jit(built.collect, donate_argnums=0)
    actors, params = state.actors, state.learning.learner.params
    sizes = []
    for _ in range(20):
        actors, _ = push(actors, params, built.pace)
        sizes.append(sum(x.nbytes for x in jax.live_arrays()))
    report = actors.tally.metrics(SUCCESSES)
    assert report["env_steps"] == 80 and report["episodes"] > 4
    assert report["reasons/nan"] == 0 and report["physics/overflows"] == 0
    assert np.isfinite(actors.env_states.physics.qpos).all()
    assert len(set(sizes[2:])) == 1, sizes


@pytest.mark.slow
def test_the_fingers_hold_a_can_and_not_the_air():
    """A cylinder of 78 mm, 1 mm from the palm, closed upon, lifted and held; beside it one out of reach."""
    env = make_env(NUM_SLOTS, FEW)
    can = env.bank.names.index("kit_salt_cylinder")
    palm = ROBOT.start.xy[0] - 0.0264
    states = []
    for x in (palm + 0.001 + 0.039, palm + 0.3):
        poses = parking_poses().astype(np.float32)
        poses[0, :3] = x, 0.0, 0.0
        ids = np.append(can, np.full(MAX_OBJECTS - 1, -1)).astype(np.int32)
        states.append(env.start(SceneParams(jnp.asarray(ids), jnp.asarray(poses), jnp.int32(0))))
    assert all(state.hand.aperture == ROBOT.start.aperture for state in states)
    grasps = jax.jit(jax.vmap(env.grasp))(jax.tree.map(lambda *x: jnp.stack(x), *states))
    np.testing.assert_array_equal(grasps.held, [True, False])
    assert not grasps.diverged.any() and not grasps.overflows.any()


@pytest.mark.slow
def test_evaluation_counts_every_episode(full_env):
    result = Evaluator(full_env, num_envs=2).run(scripts.SCRIPTS["guided"](full_env), episodes=2)
    assert [episode.scene for episode in result.episodes] == [0, 1]
    assert all(episode.reason in (*REASONS, "grasp_failed") and episode.reason != "nan" for episode in result.episodes)
    assert result.summary()["overflows"] == 0 and sum(episode.motions for episode in result.episodes) > 0


@pytest.mark.slow
def test_the_two_scripts_run_on_mjx(tmp_path):
    """`train.py` for an episode and more, its checkpoint read by `evaluate.py`."""
    train = ["train.py", "ci", "--run-dir", str(tmp_path / "run"), "--train.minutes", "0", "--train.episodes", "2"]
    evaluate = ["evaluate.py", "--policy", str(tmp_path / "run"), "--json", str(tmp_path / "e.json")]
    evaluate += ["--episodes", "2", "--num-envs", "2", "--scene.test-scenes", "2"]
    for command in (train, evaluate):
        subprocess.run([sys.executable, *command, "--physics.engine", "mjx"], cwd=ROOT, check=True)
    rows = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert rows[-1]["eval/success_rate"] is not None
    document = json.loads((tmp_path / "e.json").read_text())
    assert document["physics"] == "mjx" and document["overflows"] == 0 and len(document["rows"]) == 2
