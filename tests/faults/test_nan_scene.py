"""A scene whose physics turns NaN ends with that reason, is counted, and harms neither its neighbours nor the learner;
what went before it is written down.

That the native engine reports such a scene, and that the real environment passes it on, is tested beside them.
"""

import dataclasses
import errno
import io
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fake_training import PictureEnv, make_config, make_trainer, rows

from pregrasp_jax.task.primitive import Plan
from pregrasp_jax.training import dump
from pregrasp_jax.training.collect import Actors
from pregrasp_jax.training.dump import load_dump
from pregrasp_jax.training.trainer import Trainer
from pregrasp_jax.types import REASONS, EnvState, StepResult

SICK = 1
NAN = REASONS.index("nan")


class FrailEnv(PictureEnv):
    """Reports what an engine reports: whether anything of a scene is not finite."""

    def conclude(self, state: EnvState, plan: Plan, physics: Any) -> tuple[EnvState, StepResult]:
        next_state, result = super().conclude(state, plan, physics)
        diverged = ~jnp.all(jnp.isfinite(state.centroids))
        outcome = result.outcome.replace(diverged=diverged)
        reward, terminated, reason = self.rules.judge(outcome, state.scene.target)
        reason = jnp.where(diverged, reason, result.reason)
        truncated = result.truncated & ~diverged
        return next_state, StepResult(outcome, reward, terminated, truncated, reason, result.seconds)


def poison(actors: Actors) -> Actors:
    states = actors.env_states
    return actors.replace(env_states=states.replace(centroids=states.centroids.at[SICK, 0, 0].set(jnp.nan)))


@pytest.fixture(scope="module")
def trainer(tmp_path_factory) -> Trainer:
    config = make_config(episodes=24)
    return make_trainer(tmp_path_factory.mktemp("runs") / "frail", config, env=FrailEnv())


def test_the_scene_ends_and_its_neighbours_do_not_notice(trainer):
    program = trainer.program.compile(trainer.state)
    params = trainer.state.learning.learner.params

    def collect(actors: Actors) -> Any:
        return program.collect(jax.tree.map(jnp.copy, actors), params, program.pace)  # which donates its actors

    healthy, steps = collect(trainer.state.actors)
    sick, sick_steps = collect(poison(trainer.state.actors))
    assert not healthy.tally.reasons[NAN] and sick.tally.reasons[NAN] == 1
    steps, sick_steps = steps.steps, sick_steps.steps
    assert sick_steps.terminated[SICK] and not sick_steps.truncated[SICK] and sick_steps.reward[SICK] == 0
    assert sick.env_states.num_pushes[SICK] == 0 and np.isfinite(sick.env_states.centroids).all(), "it starts anew"
    neighbours = np.arange(3) != SICK
    pairs = zip(*map(jax.tree.leaves, ((healthy.env_states, steps), (sick.env_states, sick_steps))), strict=True)
    for expected, leaf in pairs:
        np.testing.assert_array_equal(np.asarray(leaf)[neighbours], np.asarray(expected)[neighbours])


def test_a_training_counts_such_scenes_and_goes_on(trainer):
    poisoned = []

    def poison_every_third_step() -> bool:
        if len(poisoned) % 3 == 0:
            trainer.state = dataclasses.replace(trainer.state, actors=poison(trainer.state.actors))
        poisoned.append(len(poisoned) % 3 == 0)
        return False

    with trainer.recorder.folder:
        assert trainer.run(poison_every_third_step).startswith("done: ")
    log = [row for row in rows(trainer.recorder.folder.path) if "train/loss" in row]
    assert [row["physics/diverged"] for row in log] == [row["reasons/nan"] for row in log]
    logged_steps = log[-1]["env_steps"] // trainer.config.train.num_envs
    assert sum(row["reasons/nan"] for row in log) == sum(poisoned[:logged_steps]) > 2
    losses = [row["train/loss"] for row in log if row["train/loss"] is not None]
    assert len(losses) > 2 and np.isfinite(losses).all()
    num_reports = sum(row["reasons/nan"] > 0 for row in log)
    dumps = [load_dump(path) for path in sorted(trainer.recorder.folder.dumps.iterdir())]
    assert len(dumps) in (num_reports, num_reports + 1), "one for each report, and what came after the last"
    for dumped in dumps:
        assert np.isnan(dumped.arrays["state/centroids"][0, 0]), "the state is that before the push"
        assert int(dumped.arrays["scene"]) == SICK and int(dumped.arrays["branch"]) == 0
        assert dumped.path.name == f"step-{int(dumped.arrays['env_steps']):06d}-scene-{SICK}.npz"
        assert dumped.config == trainer.config and dumped.hull_bank_hash == "hulls"
    assert len({int(dumped.arrays["env_steps"]) for dumped in dumps}) == len(dumps)


def collect_poisoned(path: Path, steps: int, **options: Any) -> tuple[Trainer, list[str]]:
    """Train with a poisoned scene in every step, each of which is reported; return what was said of it."""
    said = io.StringIO()
    trainer = make_trainer(path, make_config(log_every=3), env=FrailEnv(), said=said, **options)
    left = iter(range(steps))

    def poison_every_step() -> bool:
        trainer.state = dataclasses.replace(trainer.state, actors=poison(trainer.state.actors))
        return next(left, None) is None

    with trainer.recorder.folder:
        trainer.run(poison_every_step)
    return trainer, [line for line in said.getvalue().splitlines() if "no dump" in line or "replay-dump" in line]


def test_a_run_writes_no_more_than_so_many_dumps(tmp_path, monkeypatch):
    monkeypatch.setattr(dump, "MAX_DUMPS", 2)
    trainer, said = collect_poisoned(tmp_path / "run", 4)
    names = sorted(path.name for path in trainer.recorder.folder.dumps.iterdir())
    assert names == ["step-000003-scene-1.npz", "step-000006-scene-1.npz"]
    assert said == [
        f"the physics diverged at step {step} in scene 1; `pregrasp-jax replay-dump "
        f"{trainer.recorder.folder.dumps / name}` repeats the push"
        for step, name in zip((3, 6), names, strict=True)
    ]
    assert sum(row.get("physics/diverged", 0) for row in rows(trainer.recorder.folder.path)) == 4, "all are counted"
    mishap = trainer.state.actors.mishap.replace(scene=jnp.int32(1))
    assert trainer.recorder.dump_fn(trainer.recorder.folder.dumps, mishap.replace(env_steps=jnp.int32(9))) is None
    again = trainer.recorder.dump_fn(trainer.recorder.folder.dumps, mishap.replace(env_steps=jnp.int32(6)))
    assert again == trainer.recorder.folder.dumps / names[1], "a resumed run writes what it wrote before"


def test_a_dump_that_does_not_fit_is_one_warning_and_leaves_no_half(tmp_path, monkeypatch):
    def full(file: Any, **_: Any) -> None:
        file.write(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    trainer, said = collect_poisoned(tmp_path / "run", 2)
    path = tmp_path / "run"
    assert said == [
        f"warning: no dump written at step {step} (No space left on device: {path}); the last checkpoint is of step 0"
        for step in (3, 6)
    ]
    assert not list(trainer.recorder.folder.dumps.iterdir()) and len(rows(path)) == 2
