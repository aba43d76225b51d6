"""Everything by hand, in Python: make an environment, step it, train, save, load, evaluate.

Prints what every part did; a real training is `train.py`, which also logs, keeps checkpoints and resumes:

python examples/train_in_python.py
"""

import pregrasp_jax  # noqa: F401  (before jax, which reads then how many threads it may have)

# isort: split
import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import tyro

from pregrasp_jax.checkpoint import load_policy, save_policy
from pregrasp_jax.config import Config
from pregrasp_jax.evaluation import EvaluationResult, evaluate_policy
from pregrasp_jax.learning.q_function import make_q_function
from pregrasp_jax.policies.exploration import random_action
from pregrasp_jax.policies.learned import make_learned
from pregrasp_jax.presets import PRESETS
from pregrasp_jax.task.assembly import make_env
from pregrasp_jax.task.env import Env
from pregrasp_jax.training.program import make_program
from pregrasp_jax.types import REASONS


class Trained(NamedTuple):
    """What `train` returns: parameters before and after, and how many updates there were."""

    first: Any
    last: Any
    updates: int


def step(env: Env, num_envs: int) -> list[str]:
    """Push once at random in several scenes side by side, and return what became of them."""

    def one(key: jax.Array) -> jax.Array:
        reset_key, action_key = jax.random.split(key)
        state = env.reset(reset_key)
        action = random_action(action_key, env.action_mask(state.hand), env.primitive.actions)
        _, result = env.step(state, action)
        return result.reason

    reasons = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), num_envs))
    return [REASONS[reason] for reason in reasons]


def train(env: Env, config: Config, *, updates: int) -> Trained:
    """Collect until the warm-up is over, then go on and update until there were `updates`."""
    program = make_program(env, config)
    state = program.begin(jax.random.key(config.seed))
    program = program.compile(state)
    actors, learning = state.actors, state.learning
    first = jax.device_get(learning.learner.params)  # a copy: the programs reuse the memory of what they are given
    done = 0
    while done < updates:
        actors, experience = program.collect(actors, learning.learner.params, program.pace)
        learning = program.remember(learning, experience)
        if int(actors.tally.env_steps) > config.learner.warmup:
            learning = program.update(learning, np.float32(config.replay.importance_exponent), program.pace)
            done += 1
    return Trained(first, jax.device_get(learning.learner.params), done)


def main(
    *, preset: str = "demo", updates: int = 100, episodes: int = 10, folder: Path = Path("runs/by_hand")
) -> EvaluationResult:
    """Train a little, save the policy in a folder, and evaluate what was loaded from there."""
    config = dataclasses.replace(PRESETS[preset], seed=1).validate()
    env = make_env(config, split="train")
    print(f"one random push each: {', '.join(step(env, config.train.num_envs))}")

    trained = train(env, config, updates=updates)
    moved = jax.tree.map(lambda a, b: float(np.max(np.abs(a - b))), trained.first, trained.last)
    print(f"{trained.updates} updates moved a parameter by up to {max(jax.tree.leaves(moved)):.2g}")

    save_policy(folder, trained.last, config, evaluation={})
    policy = load_policy(folder)
    test = make_env(policy.config, split="test")
    q = make_q_function(policy.config.network, policy.config.task, test.primitive.actions)
    result = evaluate_policy(test, make_learned(test, q.values)(policy.params), episodes=episodes)
    print(f"{folder}: {result.successes} of {episodes} test scenes, failures {result.failures or 'none'}")
    return result


if __name__ == "__main__":
    tyro.cli(main)
