"""`python sharded_training.py RUN_DIR FUSED`: a real session in the fake world, stopped half-way and resumed.

Run by test_sharding.py with as many devices and processes as the environment says. Process 0 leaves beside the run
folder what it saw of the devices, in facts.json.
"""

import conftest  # noqa: F401  (compilation cache, NPROC)

# isort: split
import dataclasses
import json
import os
import sys
from pathlib import Path
from typing import Any

import fake_training
import jax
import jax.numpy as jnp

from pregrasp_jax.config import Config
from pregrasp_jax.settings import to_dict
from pregrasp_jax.task.primitive import Plan
from pregrasp_jax.training import processes, session
from pregrasp_jax.training.program import Program, TrainState
from pregrasp_jax.training.sharding import Layout
from pregrasp_jax.types import EnvState, StepResult

TRACES: list[int] = []
"""Grows with every trace of a push."""

EPISODES = (12, 24)
"""Before and after the resume."""


@dataclasses.dataclass(frozen=True)
class CountedEnv(fake_training.PictureEnv):
    """Notes every trace of a push; a physics engine takes seconds to trace."""

    def conclude(self, state: EnvState, plan: Plan, physics: Any) -> tuple[EnvState, StepResult]:
        TRACES.append(1)
        return super().conclude(state, plan, physics)


def make_config(episodes: int, fused_iterations: int) -> Config:
    """Return a run of 8 scenes with a branch each: 16 pushes at a time, batches of 4."""
    values = to_dict(fake_training.make_config(num_envs=8, episodes=episodes, fused_iterations=fused_iterations))
    values["physics"]["engine"] = "mjx"  # in name only
    values["exploration"] |= {"branches": 1, "epsilon_start": 0.5}
    values["learner"]["batch_size"] = 4
    values["replay"]["capacity"] = 400
    return Config.from_dict(values).validate()


def describe(built: Program, state: TrainState) -> dict[str, Any]:
    """Return how the arrays of a training lie, and whether its parts talk to other devices."""
    learning = state.learning
    scenes = jax.tree.leaves(state.actors.env_states)
    copied = jax.tree.leaves((learning.learner, learning.replay, state.actors.tally))
    return {
        "devices": jax.device_count(),
        "processes": jax.process_count(),
        "shares of scenes": sorted({leaf.sharding.shard_shape(leaf.shape)[0] for leaf in scenes}),
        "devices with scenes": sorted({len(leaf.sharding.device_set) for leaf in scenes}),
        "devices with copies": sorted({len(leaf.sharding.device_set) for leaf in copied}),
        "all copied": all(leaf.is_fully_replicated for leaf in copied),
        "gradients are added up": "all-reduce" in (built.iterate or built.update).as_text(),  # pyright: ignore
        "traces of a push": len(TRACES),
        "loops wait for each other": "all-reduce" in _loop(built.layout),
    }


def _loop(layout: Layout) -> str:
    """Return the machine code of a loop over scenes, each of another length."""
    count = layout.vmap(lambda n: jax.lax.while_loop(lambda k: k < n, lambda k: k + 1, jnp.int32(0)))
    lengths = jax.ShapeDtypeStruct((8,), jnp.int32, sharding=layout.split)
    return jax.jit(count).lower(lengths).compile().as_text() or ""


def main() -> None:
    """Train, resume, describe."""
    run_dir, fused_iterations = Path(sys.argv[1]), int(sys.argv[2])
    facts: list[dict[str, Any]] = []

    class WatchedTrainer(session.Trainer):
        def run(self, stop: Any) -> str:
            compile_program = self.program.compile
            built: list[Program] = []

            def compile_once(state: TrainState) -> Program:
                built.append(compile_program(state))
                return built[-1]

            object.__setattr__(self.program, "compile", compile_once)
            ending = super().run(stop)
            facts.append(describe(built[0], self.state))
            return ending

    fakes: dict[str, Any] = {
        "make_env": lambda config, **options: CountedEnv(),
        "make_program": lambda env, config, **options: fake_training.make_program(config, env, **options),
        "make_evaluate": lambda env, config: (fake_training.evaluate, lambda params: None),
        "Trainer": WatchedTrainer,
    }
    for name, fake in fakes.items():
        setattr(session, name, fake)
    if os.environ.get(processes.NUM_PROCESSES):
        processes.join()
    first, second = (make_config(episodes, fused_iterations) for episodes in EPISODES)
    assert session.train(first, run_dir) == 0
    TRACES.clear()
    assert session.resume(second, run_dir) == 0
    if processes.is_first():
        run_dir.with_name("facts.json").write_text(json.dumps(facts[-1]))


if __name__ == "__main__":
    main()
