"""Schedules are fractions of the run unless numbers were given, and their length is settled once."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import optax
import pytest
from fake_training import make_config, rows, run, stop_after, timeless

from pregrasp_jax import io
from pregrasp_jax.config import Config
from pregrasp_jax.presets import PRESETS
from pregrasp_jax.settings import to_dict
from pregrasp_jax.training import learn, schedules


def changed(config: Config, **stages: dict[str, Any]) -> Config:
    values = to_dict(config)
    for stage, settings in stages.items():
        values[stage] |= settings
    return Config.from_dict(values).validate()


def ends(config: Config, length: int | None) -> tuple[float, float, float]:
    return (
        schedules.epsilon_decay(config, length),
        schedules.importance_steps(config, length),
        schedules.learning_rate_steps(config, length),
    )


def test_the_published_algorithm_keeps_its_numbers():
    length = schedules.known_length(PRESETS["paper"])
    assert length == 180_000
    epsilon, importance, _ = ends(PRESETS["paper"], length)
    assert (epsilon, importance) == (20_000, 150_000)
    assert PRESETS["paper"].learner.final_learning_rate == PRESETS["paper"].learner.learning_rate


def test_a_fraction_of_the_run_by_hand():
    config = changed(
        PRESETS["cpu"],
        exploration={"epsilon_fraction": 0.25},
        replay={"importance_fraction": 0.5},
        learner={"learning_rate_fraction": 0.75, "warmup": 100, "updates_per_step": 2.0},
    )
    # 0.75 of 1000 are 750 env steps, of which the first 100 have no update.
    assert ends(config, 1_000) == (250, 500, 1_300)
    assert ends(config, None) == (math.inf,) * 3


def test_numbers_that_were_given_win_whatever_the_length():
    given = {
        "exploration": {"epsilon_decay": 7},
        "replay": {"importance_steps": 8},
        "learner": {"learning_rate_steps": 9},
    }
    config = changed(PRESETS["cpu"], **given)
    assert ends(config, None) == ends(config, 1_000) == (7, 8, 9)
    assert not schedules.depends_on_length(config) and schedules.depends_on_length(PRESETS["cpu"])


@pytest.mark.parametrize(
    ("train", "length"),
    [
        ({"env_steps": 500, "minutes": 3.0, "episodes": 7}, 500),
        ({"env_steps": 0, "minutes": 0.0, "episodes": 7}, 28),
        ({"env_steps": 0, "minutes": 3.0, "episodes": 7}, None),
    ],
)
def test_the_length_that_no_clock_decides(train, length):
    assert schedules.known_length(changed(PRESETS["ci"], train=train)) == length


def test_the_length_that_a_clock_decides():
    config = changed(PRESETS["ci"], train={"minutes": 2.0, "episodes": 1_000})
    found = schedules.measured_length(config, env_steps=100, seconds=20.0, steps_per_second=5.0)
    assert found == 100 + 5 * 100
    few = changed(config, train={"episodes": 30})
    assert schedules.measured_length(few, env_steps=100, seconds=20.0, steps_per_second=5.0) == 120
    over = schedules.measured_length(config, env_steps=100, seconds=500.0, steps_per_second=5.0)
    assert over == 100, "a run that is over its time is as long as it is"


def scheduled(**train: Any) -> Config:
    """Return a short run whose schedules are fractions."""
    config = make_config(**({"episodes": 1_000_000} | train))
    learner = {"learning_rate_steps": None, "learning_rate": 0.1, "final_learning_rate": 0.01, "warmup": 6}
    fractions = {"epsilon_decay": None, "epsilon_fraction": 0.5}
    return changed(config, learner=learner, exploration=fractions, replay={"importance_steps": None})


def test_a_run_ends_after_its_env_steps_and_its_schedules_with_it(tmp_path):
    trainer = run(tmp_path / "run", scheduled(env_steps=60))
    assert trainer.recorder.counters.env_steps == 60 and trainer.recorder.counters.length == 60
    epsilon = {row["env_steps"]: row["train/epsilon"] for row in rows(tmp_path / "run") if "train/epsilon" in row}
    assert epsilon[18] == pytest.approx(1 - 0.9 * 18 / 30) and epsilon[60] == pytest.approx(0.1)


def test_a_length_of_minutes_is_settled_once_and_survives_a_stop_and_other_minutes(tmp_path, monkeypatch):
    """Sixty steps of which the clock says that they are as many as fit into the minutes, then a slower machine."""
    calls = []

    def measure(config: Config, *, env_steps: int, seconds: float, steps_per_second: float) -> int:
        calls.append((env_steps, seconds > 0 and steps_per_second > 0))
        return 60

    monkeypatch.setattr(schedules, "measured_length", measure)
    config = scheduled(minutes=500.0)
    whole = run(tmp_path / "whole", config, stop=stop_after(20))
    settled = 6 + schedules.MEASURED_STEPS * 3
    assert calls == [(settled, True)] and whole.recorder.counters.length == 60
    epsilon = {row["env_steps"]: row["train/epsilon"] for row in rows(tmp_path / "whole")}
    assert epsilon[settled - 6] == 1.0 and epsilon[settled + 6] == pytest.approx(0.1), "until then nothing moves"

    path: Path = tmp_path / "pieces"
    assert run(path, config, stop=stop_after(14)).recorder.counters.length == 60
    monkeypatch.setattr(schedules, "measured_length", lambda *args, **options: 7_000)
    longer = changed(config, train={"minutes": 900.0})
    assert run(path, longer, resume=True, stop=stop_after(6)).recorder.counters.length == 60
    assert timeless(path) == timeless(tmp_path / "whole")


def test_a_run_of_the_first_release_goes_on(tmp_path):
    """Its configuration has numbers and neither fractions nor env_steps; its checkpoint knows no length."""
    old = to_dict(make_config(episodes=8))
    del old["train"]["env_steps"], old["replay"]["importance_fraction"]
    del old["learner"]["learning_rate_fraction"], old["exploration"]["epsilon_fraction"]
    old["learner"]["learning_rate_steps"] = 30
    config = Config.from_dict(old).validate()
    run(tmp_path / "old", config, stop=stop_after(4))
    for file in (tmp_path / "old" / "checkpoints").glob("*/manifest.json"):
        manifest = json.loads(file.read_text())
        del manifest["checksum"], manifest["extra"]["length"]
        io.write_json(file, {"checksum": io.content_hash(manifest), **manifest})
    trainer = run(tmp_path / "old", config, resume=True)
    assert trainer.pace.epsilon_decay == 64 and trainer.pace.learning_rate_steps == 30
    assert trainer.recorder.counters.length == 32 and rows(tmp_path / "old")[-1]["episodes"] >= 8


def test_the_optimizer_has_the_state_that_it_had_in_the_first_release():
    steady = PRESETS["ci"].learner
    for steps, then in ((0, optax.adam(1e-4)), (30, optax.adam(optax.linear_schedule(1e-4, 1e-5, 30)))):
        config = dataclasses.replace(steady, learning_rate_steps=steps)
        now = learn.make_optimizer(config, 30)
        params = {"w": jnp.zeros(3)}
        assert jax.tree.structure(now.init(params)) == jax.tree.structure(then.init(params))
