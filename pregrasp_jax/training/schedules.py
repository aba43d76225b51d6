"""Where schedules end: after a number that was asked for, or with a fraction of the run, whose length is settled once.

The length is counted in env steps. It is kept in the checkpoints, so that a run that was stopped and resumed goes on as
it would have, whatever the machine does meanwhile.
"""

import math
from typing import NamedTuple

import numpy as np

from pregrasp_jax.config import Config

PUSHES_PER_EPISODE = 4
"""What an episode counts for; 3.5 to 3.9 were measured, more of them while pushes are random."""

MEASURED_STEPS = 8
"""Parallel steps after the warm-up by which the speed is measured."""


class Pace(NamedTuple):
    """Where two schedules end, as compiled programs take it; infinite keeps their start until the length is known.

    Attributes:
        epsilon_decay: () float32 env steps.
        learning_rate_steps: () float32 updates.
    """

    epsilon_decay: np.float32
    learning_rate_steps: np.float32


def make_pace(config: Config, length: int | None) -> Pace:
    """Return where the schedules of a run of `length` env steps end, None if that is not known yet."""
    return Pace(np.float32(epsilon_decay(config, length)), np.float32(learning_rate_steps(config, length)))


def epsilon_decay(config: Config, length: int | None) -> float:
    """Return the env steps over which epsilon falls."""
    return _given_or_part(config.exploration.epsilon_decay, config.exploration.epsilon_fraction, length)


def importance_steps(config: Config, length: int | None) -> float:
    """Return the env steps over which the importance exponent rises."""
    return _given_or_part(config.replay.importance_steps, config.replay.importance_fraction, length)


def learning_rate_steps(config: Config, length: int | None) -> float:
    """Return the updates over which the step size decays."""
    learner = config.learner
    if learner.learning_rate_steps is not None:
        return float(max(1, learner.learning_rate_steps))
    if length is None:
        return math.inf
    return float(max(1, round((learner.learning_rate_fraction * length - learner.warmup) * learner.updates_per_step)))


def known_length(config: Config) -> int | None:
    """Return the env steps of a run, None where that depends on how fast it is."""
    train = config.train
    if train.env_steps:
        return train.env_steps
    return None if train.minutes else PUSHES_PER_EPISODE * train.episodes


def measured_length(config: Config, *, env_steps: int, seconds: float, steps_per_second: float) -> int:
    """Return the env steps of a run that a clock ends.

    Args:
        config: the run.
        env_steps: so far.
        seconds: training time so far.
        steps_per_second: env steps from now on.
    """
    by_time = env_steps + steps_per_second * max(0.0, 60 * config.train.minutes - seconds)
    return max(1, round(min(by_time, PUSHES_PER_EPISODE * config.train.episodes)))


def depends_on_length(config: Config) -> bool:
    """Return whether any schedule is a fraction of the run."""
    return None in (
        config.exploration.epsilon_decay,
        config.replay.importance_steps,
        config.learner.learning_rate_steps,
    )


def _given_or_part(given: int | None, fraction: float, length: int | None) -> float:
    if given is not None:
        return float(given)
    return math.inf if length is None else float(max(1, round(fraction * length)))
