"""Many pushes with automatic resets, to see whether anything leaks or goes astray; prints one JSON object.

    python benchmarks/soak.py [--pushes 20000] [--scenes 16]

The scenes are pushed by the function that training collects with, by guided random actions. A scene is unexplained
if it diverged, or goes on although something of it is not finite or an object lies below the table.
"""

import pregrasp_jax  # noqa: F401  (sets NPROC before jax is imported)

# isort: split
import argparse
import dataclasses
import functools
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from pregrasp_jax.config import Config
from pregrasp_jax.learning.q_function import make_q_function
from pregrasp_jax.presets import PRESETS
from pregrasp_jax.startup import prepare
from pregrasp_jax.task.assembly import make_env
from pregrasp_jax.task.env import Env
from pregrasp_jax.training import collect
from pregrasp_jax.training.schedules import known_length, make_pace
from pregrasp_jax.types import EnvState

MIN_HEIGHT = -0.01
"""m; the origin of an object lies on its base plane or, when it has fallen over, above the table."""


def memory_bytes() -> int:
    """Return the memory that this process holds now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def num_astray(states: EnvState, outcome: Any) -> int:
    """Return how many of E running scenes nobody can explain; those that diverged are counted as reasons.

    Args:
        states: after the push; those that ended have begun anew.
        outcome: of the push.
    """
    present = np.asarray(states.scene.object_ids) >= 0
    poses = np.asarray(states.physics_obs.object_poses)
    below = (present & (poses[..., 2] < MIN_HEIGHT)).any(axis=1)
    measured = (states.physics_obs, states.obs, states.centroids, outcome)
    infinite = [
        ~np.isfinite(np.asarray(leaf).reshape(len(present), -1)).all(axis=1) for leaf in jax.tree.leaves(measured)
    ]
    return int(((below | np.any(infinite, axis=0)) & ~np.asarray(outcome.diverged)).sum())


def soak(env: Env, num_pushes: int, config: Config) -> dict[str, Any]:
    """Push until `num_pushes` are done, and return the findings."""
    q = make_q_function(config.network, config.task, env.primitive.actions)
    params = jax.jit(q.init)(jax.random.key(config.seed))
    make_actors = functools.partial(collect.init_actors, env=env, num_envs=config.train.num_envs)
    actors = jax.jit(make_actors)(jax.random.key(config.seed))
    push = collect.make_collect(env, q, config.exploration, warmup=config.learner.warmup)
    pace = make_pace(config, known_length(config) or num_pushes)
    push = push.compile(actors, params, pace)
    num_steps = -(-num_pushes // config.train.num_envs)
    marks = {max(1, round(share * num_steps)): f"{share:.0%}" for share in (0.1, 0.5, 1.0)}
    memory, astray = {}, 0
    start = time.perf_counter()
    for step in range(1, num_steps + 1):
        actors, experience = push(actors, params, pace)
        astray += num_astray(actors.env_states, experience.steps.outcome)
        if step in marks:
            memory[marks[step]] = memory_bytes()
            print(f"{marks[step]} after {time.perf_counter() - start:.0f} s", file=sys.stderr)
    seconds = time.perf_counter() - start
    counts = actors.tally.metrics(env.rules.successes)
    reasons = {name.removeprefix("reasons/"): n for name, n in counts.items() if name.startswith("reasons/")}
    return {
        "pushes": counts["env_steps"],
        "episodes": counts["episodes"],
        "seconds": seconds,
        "pushes_per_second": counts["env_steps"] / seconds,
        "memory_mb": {share: size / 1e6 for share, size in memory.items()},
        "memory_growth": memory["100%"] / memory["10%"] - 1,
        "reasons": reasons,
        "unexplained": astray + reasons["nan"],
        "scenes": config.train.num_envs,
        "cores": len(os.sched_getaffinity(0)),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pushes", type=int, default=20_000, help="pushes in all")
    parser.add_argument("--scenes", type=int, default=16, help="scenes side by side")
    parser.add_argument("--scenes-packed", type=int, default=512, help="scenes in the bank that resets draw from")
    arguments = parser.parse_args()
    prepare()
    preset = PRESETS["cpu"]
    config = dataclasses.replace(
        preset,
        scene=dataclasses.replace(preset.scene, train_scenes=arguments.scenes_packed),
        train=dataclasses.replace(preset.train, num_envs=arguments.scenes),
        learner=dataclasses.replace(preset.learner, warmup=10_000_000),  # all pushes are random
        exploration=dataclasses.replace(preset.exploration, branches=0),
    )
    print(json.dumps(soak(make_env(config, split="train"), arguments.pushes, config), indent=2))


if __name__ == "__main__":
    main()
