"""A scene whose physics turns NaN ends with that reason, is counted, and harms neither its neighbours nor the learner.

That the native engine reports such a scene, and that the real environment passes it on, is tested beside them.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fake_training import PictureEnv, make_config, make_trainer, rows

from pregrasp_jax.judge import judge
from pregrasp_jax.training.collect import Actors
from pregrasp_jax.training.trainer import Trainer
from pregrasp_jax.types import REASONS, EnvState, StepResult

SICK = 1
NAN = REASONS.index("nan")


class FrailEnv(PictureEnv):
    """Reports what an engine reports: whether anything of a scene is not finite."""

    def step(self, state: EnvState, action: jax.Array) -> tuple[EnvState, StepResult]:
        next_state, result = super().step(state, action)
        diverged = ~jnp.all(jnp.isfinite(state.centroids))
        outcome = result.outcome.replace(diverged=diverged)
        reward, terminated, reason = judge(outcome, state.scene.target)
        reason = jnp.where(diverged, reason, result.reason)
        truncated = result.truncated & ~diverged
        return next_state, StepResult(outcome, reward, terminated, truncated, reason)


def poison(actors: Actors) -> Actors:
    states = actors.env_states
    return actors.replace(env_states=states.replace(centroids=states.centroids.at[SICK, 0, 0].set(jnp.nan)))


@pytest.fixture(scope="module")
def trainer(tmp_path_factory) -> Trainer:
    config = make_config(episodes=24)
    return make_trainer(tmp_path_factory.mktemp("runs") / "frail", config, env=FrailEnv())


def test_the_scene_ends_and_its_neighbours_do_not_notice(trainer):
    program, _ = trainer.program.compile(trainer.state)
    params = trainer.state.learning.learner.params

    def collect(actors: Actors) -> Any:
        return program.collect(jax.tree.map(jnp.copy, actors), params)  # which donates its actors

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

    with trainer.folder:
        assert trainer.run(poison_every_third_step).startswith("done: ")
    log = [row for row in rows(trainer.folder.path) if "train/loss" in row]
    logged_steps = log[-1]["env_steps"] // trainer.config.train.num_envs
    assert sum(row["reasons/nan"] for row in log) == sum(poisoned[:logged_steps]) > 2
    losses = [row["train/loss"] for row in log if row["train/loss"] is not None]
    assert len(losses) > 2 and np.isfinite(losses).all()
