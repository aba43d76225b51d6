"""The learner's side of training: remember a push of every scene, and update.

The two are compiled apart and the host repeats the update: inside a loop of XLA's CPU compiler, convolutions
lose their fast kernels and an update takes several times as long.
"""

import math
from collections.abc import Callable
from typing import Any

import flax.struct as struct
import jax
import jax.numpy as jnp
import optax
from optax.contrib import MuonDimensionNumbers, muon

from pregrasp_jax.config import LearnerConfig, ReplayConfig
from pregrasp_jax.learning import hindsight, learner
from pregrasp_jax.learning import replay as replay_lib
from pregrasp_jax.learning.learner import LearnerState
from pregrasp_jax.learning.networks import PATH_READOUT, READOUT
from pregrasp_jax.learning.q_function import Params
from pregrasp_jax.learning.records import Replay, Steps
from pregrasp_jax.policies.exploration import linear_schedule
from pregrasp_jax.task.rules import Rules
from pregrasp_jax.training.collect import Experience
from pregrasp_jax.training.schedules import Pace

_MUON_RMS = 0.2
"""Root mean square of an update of a kernel by Muon, in step sizes: that of Adam in practice."""


class Learning(struct.PyTreeNode):
    """State of the learner.

    Attributes:
        learner: parameters, target parameters, optimizer, gradient steps.
        replay: memory, and where the running episodes lie in it.
        key: PRNG key of sampling.
        updates: () int32 since the last report.
        metrics: of those updates: the largest of ``*_max``, the smallest of ``*_min``, sums of all others.
    """

    learner: LearnerState
    replay: Replay
    key: jax.Array
    updates: jax.Array
    metrics: dict[str, jax.Array]

    def begin_report(self) -> "Learning":
        """Return the state with updates and metrics counted anew."""
        return self.replace(updates=jnp.zeros_like(self.updates), metrics=jax.tree.map(jnp.zeros_like, self.metrics))


RememberFn = Callable[[Learning, Experience], Learning]
"""``(state, experience) -> state``."""

UpdateFn = Callable[[Learning, Any, Pace], Learning]
"""``(state, beta () float32, pace) -> state``; beta is the importance exponent."""


def num_updates(env_steps: int, config: LearnerConfig) -> int:
    """Return how many updates are due in all after `env_steps` pushes; fractions wait until they add up to one."""
    return int(max(0, env_steps - config.warmup) * config.updates_per_step)


def init_learning(
    key: jax.Array,
    params: Params,
    steps: Steps,
    replay_config: ReplayConfig,
    optimizer: optax.GradientTransformation,
    *,
    max_pushes: int,
    num_siblings: int = 1,
) -> Learning:
    """Return a learner without experience.

    Args:
        key: for sampling.
        params: initial parameters.
        steps: a `Steps` of E scenes, or its shapes.
        replay_config: capacity.
        optimizer: see `make_optimizer`.
        max_pushes: longest episode.
        num_siblings: pushes from one state that are learned from together, see `replay.init`.
    """
    memory = replay_lib.init(steps, capacity=replay_config.capacity, max_pushes=max_pushes, num_siblings=num_siblings)
    return Learning(
        learner=learner.init(params, optimizer),
        replay=memory,
        key=key,
        updates=jnp.int32(0),
        metrics={name: jnp.float32(0) for name in METRICS},
    )


def make_remember(config: ReplayConfig, rules: Rules) -> RememberFn:
    """Return the function that adds one push of every scene to the memory, and hindsight rows where they are due."""

    def remember(state: Learning, experience: Experience) -> Learning:
        replay = replay_lib.add(state.replay, experience.steps)
        if config.hindsight:
            replay = hindsight.add_hindsight(replay, experience.eligible, rules)
        return state.replace(replay=replay)

    return remember


def make_update(config: LearnerConfig, **options: Any) -> UpdateFn:
    """Return the function that updates once; `options` go to `learner.sample_and_update`."""

    def update(state: Learning, beta: jax.Array, pace: Pace) -> Learning:
        key, sample_key = jax.random.split(state.key)
        learner_state, replay, metrics = learner.sample_and_update(
            state.learner,
            state.replay,
            sample_key,
            importance_exponent=beta,
            optimizer=make_optimizer(config, pace.learning_rate_steps),
            config=config,
            **options,
        )
        metrics = _accumulate(state.metrics, metrics, state.updates)
        return Learning(learner_state, replay, key, state.updates + 1, metrics)

    return update


def make_optimizer(config: LearnerConfig, steps: Any = math.inf) -> optax.GradientTransformation:
    """Return Adam or Muon, the step size constant or decaying linearly.

    Muon makes the update of a kernel orthogonal, so that no few directions take most of it, and as large as one of Adam
    usually is (root mean square 0.2): the same step sizes suit both. Biases and the readout keep Adam, with Nesterov's
    momentum as Muon has it.

    Args:
        config: which one, and where the step size begins and ends.
        steps: () updates after which it stays, see `schedules`. The state of the optimizer does not depend on it.

    Source: Jordan et al. 2024 (Muon); Liu et al. 2025 for the size of its updates.
    """

    def decaying(count: Any) -> jax.Array:
        start, end = config.learning_rate, config.final_learning_rate
        return linear_schedule(jnp.asarray(count), start=start, end=end, steps=steps)

    rate = config.learning_rate if config.learning_rate_steps == 0 else decaying
    if config.optimizer == "adam":
        return optax.adam(rate)
    return muon(rate, consistent_rms=_MUON_RMS, muon_weight_dimension_numbers=_kernels)


def _kernels(params: Params) -> Any:
    """Return which axes of a kernel [rows, cols, C_in, C_out] are those of its matrix; None for all else."""

    def matrix(path: tuple[Any, ...], leaf: jax.Array) -> MuonDimensionNumbers | None:
        readout = any(getattr(key, "key", None) in (READOUT, PATH_READOUT) for key in path)
        return MuonDimensionNumbers((0, 1, 2), 3) if leaf.ndim == 4 and not readout else None

    return jax.tree_util.tree_map_with_path(matrix, params)


METRICS = (
    "train/loss",
    "train/td_error",
    "train/target_mean",
    "train/target_min",
    "train/target_max",
    "train/q_taken",
    "train/grad_norm",
    "train/share_success",
    "train/share_approach",
    "train/share_nothing",
    "train/share_hindsight",
)
"""What `learner.update` measures."""


def _accumulate(total: dict[str, jax.Array], new: dict[str, jax.Array], count: jax.Array) -> dict[str, jax.Array]:
    def merge(name: str) -> jax.Array:
        if name.endswith("_max"):
            return jnp.where(count == 0, new[name], jnp.maximum(total[name], new[name]))
        if name.endswith("_min"):
            return jnp.where(count == 0, new[name], jnp.minimum(total[name], new[name]))
        return total[name] + new[name]

    return {name: merge(name) for name in METRICS}


def metrics(state: Learning) -> dict[str, Any]:
    """Return the row of metrics () of a learner, on the host; averages over no update are None."""
    small = (state.learner.gradient_steps, state.updates, state.metrics)
    gradient_steps, updates, sums = jax.device_get(small)
    replay = state.replay
    sizes = (replay.num_alive, replay.observations_written, replay.hindsight_rows_written, replay.rows_written)
    alive, observations, hindsight_rows, rows = map(int, jax.device_get(sizes))

    def value(name: str) -> float | None:
        if not updates:
            return None
        return float(sums[name]) / (1 if name.endswith(("_max", "_min")) else int(updates))

    return {
        "gradient_steps": int(gradient_steps),
        **{name: value(name) for name in METRICS},
        "replay/size": min(observations, replay.observations.height.shape[0]),
        "replay/alive_rows": alive,
        "replay/rows": rows,
        "replay/her_rows": hindsight_rows,
    }
