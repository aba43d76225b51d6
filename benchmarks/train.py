"""Where the time of a training goes, stage by stage; prints one JSON object.

    python benchmarks/train.py [--preset cpu] [any option of `train`, for example --network.architecture paper]

Stages are compiled alone and timed on states and a memory met on the way. `ms_per_env_step` spreads each over the
pushes it serves: a checkpoint over the steps between two of them, an update over `1 / updates_per_step`.
"""

import pregrasp_jax  # noqa: F401  (sets NPROC before jax is imported)

# isort: split
import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import tyro
from timing import best_ms

from pregrasp_jax.checkpoint.state import save
from pregrasp_jax.config import Config
from pregrasp_jax.learning import learner, replay
from pregrasp_jax.learning.q_function import make_q_function
from pregrasp_jax.presets import PRESETS
from pregrasp_jax.task.assembly import make_env
from pregrasp_jax.training.program import POLICY, Program, TrainState, make_program

STEPS = 40
"""Parallel steps that fill the memory before anything is timed."""


class Chain:
    """A function (state, ...) -> state that is called on its own results, in place."""

    def __init__(self, function: Callable[..., Any], state: Any):
        self.state = state
        self._function = jax.jit(function, donate_argnums=0)

    def __call__(self, *arguments: Any) -> Any:
        """Take one step, and return the new state."""
        self.state = self._function(self.state, *arguments)
        return self.state


def fill(program: Program, state: TrainState) -> tuple[TrainState, Any]:
    """Collect `STEPS` times; return the state and the last experience."""
    collect, learning = jax.jit(program.collect), Chain(program.remember, state.learning)
    actors, experience = state.actors, None
    for _ in range(STEPS):
        actors, experience = collect(actors, learning.state.learner.params, program.pace)
        learning(experience)
    return TrainState(actors, learning.state), experience


def measure(config: Config) -> dict[str, Any]:
    """Return ms per env step of every stage, and the rates that follow."""
    env = make_env(config, split="train")
    program = make_program(env, config)
    state, experience = fill(program, jax.jit(program.init)(jax.random.key(0)))
    q = make_q_function(config.network, config.task, env.primitive.actions)
    learning, states, key = state.learning, state.actors.env_states, jax.random.key(1)
    params, memory = learning.learner.params, learning.replay
    num_envs = config.train.num_envs

    def act(params: Any, states: Any) -> jax.Array:
        return q.apply(params, jax.vmap(q.input_fn)(states.obs, states.scene.target))

    def sample(memory: replay.Replay, key: jax.Array) -> replay.Batch:
        return replay.sample(
            memory, key, batch_size=config.learner.batch_size, importance_exponent=0.4, input_fn=q.input_fn
        )

    def target(params: Any, batch: replay.Batch) -> jax.Array:
        return jax.vmap(learner.max_q)(q.apply(params, batch.next_inputs), jax.vmap(env.action_mask)(batch.next_hand))

    reset, collect, act, sample, target = (
        jax.jit(f) for f in (jax.vmap(env.reset), program.collect, act, sample, target)
    )
    batch = sample(memory, key)
    keys = jax.random.split(key, num_envs)
    ms = {
        "collect": best_ms(lambda: collect(state.actors, params, program.pace)),
        "act": best_ms(lambda: act(params, states)),
        "reset": best_ms(lambda: reset(keys)),
        "sample": best_ms(lambda: sample(memory, key)),
        "target": best_ms(lambda: target(params, batch)),
    }
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        save(Path(folder), 1, state.split()[0], state.ring(), {}, policy=POLICY)
    ms["checkpoint"] = 1e3 * (time.perf_counter() - start)
    # Last, because they take the memory and give it back changed, as in training: a copy would cost more than the work.
    remember = Chain(program.remember, learning)
    ms["remember"] = best_ms(lambda: remember(experience))
    update = Chain(program.update, remember.state)
    ms["update"] = best_ms(lambda: update(jnp.float32(0.4), program.pace))
    return summary(ms, config)


def summary(ms: dict[str, float], config: Config) -> dict[str, Any]:
    """Turn times of whole calls into times per env step."""
    num_envs, updates = config.train.num_envs, config.learner.updates_per_step
    per_step = {
        "push": (ms["collect"] - ms["act"] - ms["reset"]) / num_envs,
        "act": ms["act"] / num_envs,
        "reset": ms["reset"] / num_envs,
        "remember": ms["remember"] / num_envs,
        "sample": updates * ms["sample"],
        "target": updates * ms["target"],
        "gradient": updates * (ms["update"] - ms["sample"] - ms["target"]),
    }
    total = sum(per_step.values())
    # A checkpoint writes what is new: here all of the memory, in training the pushes of `checkpoint_minutes`.
    per_step["checkpoint"] = ms["checkpoint"] / (60e3 * config.train.checkpoint_minutes / total)
    total += per_step["checkpoint"]
    return {
        "ms_per_env_step": {name: round(value, 3) for name, value in per_step.items()},
        "env_steps_per_second": 1e3 / total,
        "gradient_steps_per_second": updates * 1e3 / total,
        "update_ms_per_sample": ms["update"] / config.learner.batch_size,
        "checkpoint_ms": ms["checkpoint"],
        "branches": config.exploration.branches,
        "cores": len(os.sched_getaffinity(0)),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", choices=sorted(PRESETS), default="cpu", help="configuration that is profiled")
    arguments, options = parser.parse_known_args()
    config = tyro.cli(Config, default=PRESETS[arguments.preset], args=options, config=(tyro.conf.FlagConversionOff,))
    print(json.dumps(measure(config.validate()), indent=2))


if __name__ == "__main__":
    main()
