"""The training loop on a world without physics: bookkeeping, determinism, resume; for faults see tests/faults."""

import dataclasses
import io
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drawn_params import drawn_params
from fake_env import ACTIONS
from fake_training import (
    PictureEnv,
    make_config,
    make_program,
    make_trainer,
    never,
    rows,
    run,
    stop_after,
    timeless,
)

from pregrasp_jax.checkpoint import checksum, load_policy
from pregrasp_jax.config import ExplorationConfig, NetworkConfig, TaskConfig
from pregrasp_jax.learning import learner
from pregrasp_jax.learning.members import split
from pregrasp_jax.learning.q_function import make_q_function
from pregrasp_jax.presets import PRESETS
from pregrasp_jax.task.primitive import Plan
from pregrasp_jax.training import learn, program
from pregrasp_jax.training.run_folder import RunFolder, stored_config
from pregrasp_jax.training.trainer import Trainer
from pregrasp_jax.types import PUSH_REASONS, EnvState, StepResult


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Trainer:
    return run(tmp_path_factory.mktemp("runs") / "whole", make_config(episodes=24))


def test_metrics_add_up(finished):
    log = [row for row in rows(finished.recorder.folder.path) if "train/loss" in row]
    assert [row["env_steps"] for row in log] == list(range(6, log[-1]["env_steps"] + 1, 6))
    ended = sum(row[f"reasons/{name}"] for row in log for name in PUSH_REASONS if name != "running")
    assert ended == log[-1]["episodes"] > 10
    last = log[-1]
    assert last["gradient_steps"] == int((last["env_steps"] - 9) * 0.25)
    assert last["replay/rows"] == last["env_steps"] + last["replay/her_rows"]
    assert 0 < last["replay/size"] <= 70
    assert last["time/collect"] > 0 and last["time/learn"] > 0
    assert log[0]["train/loss"] is None and last["train/loss"] > 0
    assert log[0]["train/explored"] == 1.0, "the warm-up explores only"
    assert last["train/epsilon"] == pytest.approx(1.0 - 0.9 * min(1.0, last["env_steps"] / 64))


def test_a_finished_run_leaves_everything(finished):
    path = finished.recorder.folder.path
    assert finished.recorder.saved and finished.recorder.counters.episodes >= 24
    assert stored_config(path) == finished.config
    assert load_policy(path).evaluation["success_rate"] == 0.25
    assert checksum(load_policy(path).params) == checksum(finished.state.learning.learner.target_params)
    last = rows(path)[-1]
    assert last["eval/success_rate"] == 0.25 and last["time/seconds"] > 0


def test_same_seed_same_metrics(tmp_path, finished):
    run(tmp_path / "again", finished.config)
    assert timeless(tmp_path / "again") == timeless(finished.recorder.folder.path)
    other = dataclasses.replace(finished.config, seed=1)
    run(tmp_path / "other", other)
    assert timeless(tmp_path / "other") != timeless(finished.recorder.folder.path)


def test_interrupted_and_resumed_equals_uninterrupted(tmp_path, finished):
    path = tmp_path / "halves"
    first = run(path, finished.config, stop=stop_after(7))
    assert first.recorder.counters.env_steps == 7 * 3 and first.recorder.saved
    second = run(path, finished.config, resume=True)
    assert checksum(second.state) == checksum(finished.state)
    assert timeless(path) == timeless(finished.recorder.folder.path)


def test_a_run_of_several_networks_that_learn_by_muon_is_resumed_as_if_it_had_not_stopped(tmp_path):
    config = make_config(episodes=12)
    config = dataclasses.replace(
        config,
        network=dataclasses.replace(config.network, members=2),
        learner=dataclasses.replace(config.learner, optimizer="muon"),
    )
    whole = run(tmp_path / "whole", config)
    begun = jax.tree.map(np.asarray, make_trainer(tmp_path / "other", config).state.learning.learner.params)
    run(tmp_path / "halves", config, stop=stop_after(5))
    resumed = run(tmp_path / "halves", config, resume=True)
    assert checksum(resumed.state) == checksum(whole.state)
    assert timeless(tmp_path / "halves") == timeless(tmp_path / "whole")
    learned = load_policy(tmp_path / "whole").params
    for member in range(2):
        before, after = (split(params, 2)[member]["conv"]["kernel"] for params in (begun, learned))
        assert np.abs(after - before).max() > 1e-6, f"network {member} has learned nothing"


def test_resume_repeats_what_a_crash_lost(tmp_path, finished):
    """A crash after the checkpoint: its metrics rows are measured again, and a cut last line goes."""
    path = tmp_path / "crashed"
    trainer = make_trainer(path, finished.config)
    with trainer.recorder.folder:
        trainer.run(stop_after(4))
        trainer.recorder._saved_at = trainer.recorder.counters.env_steps + 3  # what follows is not saved
        trainer.run(stop_after(1))
    with (path / "metrics.jsonl").open("a") as file:
        file.write('{"env_steps": 15, "cut')
    second = run(path, finished.config, resume=True)
    assert checksum(second.state) == checksum(finished.state)
    assert timeless(path) == timeless(finished.recorder.folder.path)


def test_every_session_leaves_an_event_file_if_asked(tmp_path):
    pytest.importorskip("tensorboardX")
    path, config = tmp_path / "run", make_config(episodes=12, tensorboard=True)
    run(path, config, stop=stop_after(3))
    run(path, config, resume=True)
    sizes = [file.stat().st_size for file in sorted((path / "tensorboard").iterdir())]
    assert len(sizes) == 2 and min(sizes) > 500
    run(tmp_path / "silent", make_config(episodes=1))
    assert not (tmp_path / "silent" / "tensorboard").exists()


def test_a_run_can_be_extended_but_not_changed(tmp_path):
    path, config = tmp_path / "run", make_config(episodes=6)
    first = run(path, config)
    longer = dataclasses.replace(config, train=dataclasses.replace(config.train, episodes=14))
    with RunFolder.open(path, longer) as folder:
        assert stored_config(path) == config, "until objects, scenes and resources have been found to do"
        folder.begin_session(longer, {})
        assert stored_config(path) == longer
    assert run(path, longer, resume=True).recorder.counters.episodes >= 14 > first.recorder.counters.episodes
    changed = dataclasses.replace(longer, exploration=ExplorationConfig(guided=False))
    with pytest.raises(ValueError, match=r"exploration.guided: True -> False.*allowed to change: train.minutes"):
        RunFolder.open(path, changed)
    with pytest.raises(ValueError, match="already holds a run; continue it with"):
        RunFolder.create(path, longer)


def test_a_complete_run_says_so(tmp_path, finished):
    trainer = make_trainer(finished.recorder.folder.path, finished.config, resume=True)
    with trainer.recorder.folder:
        assert "is complete" in trainer.run(never)


def test_a_run_that_died_in_its_last_evaluation_has_it_when_it_is_resumed(tmp_path):
    path, config = tmp_path / "run", make_config(episodes=6, checkpoint_minutes=0.0)
    trainer = make_trainer(path, config)
    trainer.recorder.evaluate_fn = lambda params: pytest.fail("killed")
    with trainer.recorder.folder, pytest.raises(pytest.fail.Exception):
        trainer.run(never)
    assert not (path / "best").exists()
    run(path, config, resume=True)
    assert load_policy(path).evaluation["success_rate"] == 0.25


def test_compiling_the_evaluation_is_announced_measured_and_no_training_time(tmp_path):
    said = io.StringIO()
    trainer = make_trainer(tmp_path / "run", make_config(episodes=6), said=said)

    def compile_evaluation(params: Any) -> None:
        assert trainer.recorder.counters.env_steps == 0 and said.getvalue() == "compiling ...\n"
        assert checksum(params) == checksum(trainer.state.learning.learner.target_params)
        time.sleep(2.0)

    trainer.compile_evaluation = compile_evaluation
    start = time.perf_counter()
    with trainer.recorder.folder:
        trainer.run(never)
    assert trainer.recorder.counters.total_seconds < time.perf_counter() - start - 2.0
    assert all(row["time/compile"] > 2.0 for row in rows(tmp_path / "run") if "train/loss" in row)


@pytest.mark.parametrize(
    ("engine", "backend", "asked", "fused"),
    [
        ("mjx", "gpu", None, 4),
        ("mjx", "cpu", None, 0),
        ("native", "gpu", None, 0),
        ("mjx", "gpu", 0, 0),
        ("mjx", "cpu", 3, 3),
    ],
)
def test_one_program_of_several_iterations_where_it_pays(monkeypatch, engine, backend, asked, fused):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    config = make_config(fused_iterations=asked)
    config = dataclasses.replace(config, physics=dataclasses.replace(config.physics, engine=engine))
    assert make_program(config).fused_iterations == fused


def test_a_loss_that_is_not_finite_stops_the_run(tmp_path):
    trainer = make_trainer(tmp_path / "run", make_config(episodes=50))
    params = trainer.state.learning.learner.params
    poisoned = jax.tree.map(lambda leaf: leaf * jnp.nan, params)
    state = trainer.state.learning.learner.replace(params=poisoned)
    trainer.state = trainer.state.replace(learning=trainer.state.learning.replace(learner=state))
    with trainer.recorder.folder, pytest.raises(FloatingPointError, match="the last checkpoint is of step 0"):
        trainer.run(never)


def test_parameters_of_another_network_are_refused():
    config = make_config()
    params = make_program(config).shapes().learning.learner.params
    wider = dataclasses.replace(config, network=dataclasses.replace(config.network, width=2.0))
    make_program(config, params=params)
    with pytest.raises(ValueError, match=r"network.width = 2.0"):
        make_program(wider, params=params)


def test_initial_parameters_are_used(tmp_path):
    config = make_config()
    params = make_program(config).init(jax.random.key(77))
    params = params.learning.learner.params
    built = make_program(config, params=params)
    started = built.init(jax.random.key(0)).learning.learner
    assert checksum(started.params) == checksum(started.target_params) == checksum(params)


def test_a_policy_gets_the_path_readout_that_it_lacks():
    def q_function(path):
        network = NetworkConfig(architecture="compact", width=1 / 32, path_channels=path)
        return make_q_function(network, TaskConfig(), ACTIONS)

    env: Any = PictureEnv()
    config, q = make_config(), q_function(3)
    config = dataclasses.replace(config, network=dataclasses.replace(config.network, path_channels=3))
    params = drawn_params(q_function(None).init)
    built = program.make_program(env, config, params=params, q_function=q)
    started = jax.jit(lambda key: built.init(key).learning.learner)(jax.random.key(0)).params
    assert q.fits(started) and not started["path_readout"]["kernel"].any() and started["path"]["kernel"].any()
    assert checksum({name: started[name] for name in params}) == checksum(params)
    with pytest.raises(ValueError, match=r"network.path_channels = 3 or none"):
        program.make_program(env, config, params=drawn_params(q_function(2).init), q_function=q)


def test_updates_due_add_up_over_fractions():
    config = dataclasses.replace(PRESETS["ci"].learner, warmup=10, updates_per_step=0.3)
    assert [learn.num_updates(steps, config) for steps in (0, 10, 13, 14, 17, 20, 110)] == [0, 0, 0, 1, 2, 3, 30]


def test_the_step_size_decays_linearly_and_stays():
    steady = dataclasses.replace(PRESETS["ci"].learner, learning_rate=0.1, learning_rate_steps=0)
    decaying = dataclasses.replace(steady, final_learning_rate=0.02, learning_rate_steps=4)
    for config, expected in ((steady, [0.1] * 7), (decaying, [0.1, 0.08, 0.06, 0.04, 0.02, 0.02, 0.02])):
        optimizer = learn.make_optimizer(config, config.learning_rate_steps)
        state, sizes = optimizer.init(jnp.float32(0)), []
        for _ in expected:
            step, state = optimizer.update(jnp.float32(3), state)
            sizes.append(-float(jnp.asarray(step)))
        assert sizes == pytest.approx(expected, rel=1e-4), (
            "a constant gradient makes every step of Adam one of its size"
        )


@dataclasses.dataclass(frozen=True)
class CountingEnv(PictureEnv):
    """Notes every trace of a push; a physics engine takes seconds to trace. All are short of contacts."""

    traces: list[int] = dataclasses.field(default_factory=list)

    def conclude(self, state: EnvState, plan: Plan, physics: Any) -> tuple[EnvState, StepResult]:
        self.traces.append(1)
        next_state, result = super().conclude(state, plan, physics)
        seen = state.physics_obs
        return next_state.replace(physics_obs=seen.replace(overflows=seen.overflows + 5)), result


def test_a_push_is_traced_once_for_shapes_start_and_compilation_and_its_overflows_are_counted():
    config, env = make_config(), CountingEnv()
    built = make_program(config, env)
    built.shapes()
    state = jax.jit(built.init)(jax.random.key(0))
    compiled = built.compile(state)
    params = state.learning.learner.params
    actors, _ = compiled.collect(state.actors, params, built.pace)
    actors, _ = compiled.collect(actors, params, built.pace)
    assert len(env.traces) == 1
    assert actors.tally.metrics(built.successes)["physics/overflows"] == 2 * config.train.num_envs


def test_a_run_of_fused_iterations_measures_what_the_loop_does(tmp_path, finished):
    """Two pushes of every scene in one program: the same rows, except where float32 adds in another order."""
    fused = run(tmp_path / "fused", make_config(episodes=24, fused_iterations=2))
    logs = [[row for row in timeless(t.recorder.folder.path) if "train/loss" in row] for t in (finished, fused)]
    pairs = list(zip(*logs, strict=False))
    assert len(pairs) > 5
    for expected, got in pairs:
        assert expected.keys() == got.keys()
        for name, value in expected.items():
            assert got[name] == (value if value is None else pytest.approx(value, rel=1e-3, abs=1e-6)), name


def test_the_learner_measures_what_the_report_prints(monkeypatch):
    measured: set[str] = set()
    original = learner.update

    def spy(*args: Any, **kwargs: Any) -> Any:
        result = original(*args, **kwargs)
        measured.update(result[3])
        return result

    monkeypatch.setattr(learner, "update", spy)
    built = make_program(make_config())
    shapes = built.shapes()
    jax.eval_shape(built.update, shapes.learning, jnp.float32(0), built.pace)
    assert measured == set(learn.METRICS)
