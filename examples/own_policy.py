"""A policy of your own, on the paper's fixed test scenes: at most ten pushes, one grasp, success with an interval.

Prints the table row of `evaluate.py` for it:

python examples/own_policy.py --episodes 100
"""

import pregrasp_jax  # noqa: F401  (before jax, which reads then how many threads it may have)

# isort: split
import jax
import jax.numpy as jnp
import tyro

from pregrasp_jax.config import Config, SceneConfig
from pregrasp_jax.evaluation import EvaluationResult, evaluate_policy
from pregrasp_jax.evaluation.statistics import wilson_interval
from pregrasp_jax.policies.scripts import Policy, nearest_action
from pregrasp_jax.task.assembly import make_env
from pregrasp_jax.task.env import Env
from pregrasp_jax.types import EnvState

NEAR = 0.13
"""m, from where the open hand reaches the target in one push."""

SIDESTEP = 0.04
"""m, by how much the closed hand passes beside the line to the target."""


def make_sweep(env: Env) -> Policy:
    """Return a policy: sweep the way free with the closed hand, left and right by turns, then open and go in.

    A policy maps the state of ONE scene and a key to an action; it runs under `jax.jit` and `jax.vmap`, so choices are
    `jnp.where` and not `if`.
    """
    actions = env.primitive.actions

    def act(state: EnvState, key: jax.Array) -> jax.Array:
        del key  # nothing here is random
        to_target = state.target_xy - state.hand.xy
        distance = jnp.linalg.norm(to_target)
        left = jnp.stack([-to_target[1], to_target[0]]) / distance
        side = jnp.where(state.num_pushes % 2 == 0, SIDESTEP, -SIDESTEP)
        near = distance < NEAR
        goal = jnp.where(near, state.target_xy, state.target_xy + side * left)
        choice = jnp.where(near, actions.widest, actions.narrowest)
        return nearest_action(env.action_mask(state.hand), goal, choice, actions)

    return act


def main(*, episodes: int = 50, num_envs: int = 16) -> EvaluationResult:
    """Evaluate the policy."""
    config = Config(scene=SceneConfig(test_scenes=episodes)).validate()
    env = make_env(config, split="test")
    result = evaluate_policy(env, make_sweep(env), episodes=episodes, num_envs=num_envs)
    low, high = wilson_interval(result.successes, episodes)
    summary = result.summary()
    print(f"sweep: {result.success_rate:.0%} of {episodes} scenes ({low:.0%} to {high:.0%})")
    print(f"motions per success: {summary['mean_motions']}, failures: {result.failures or 'none'}")
    return result


if __name__ == "__main__":
    tyro.cli(main)
