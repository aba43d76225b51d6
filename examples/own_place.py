"""A place of your own: a table with a wall along its left side that ends early on the right.

Prints how often `clear` gets the target between its fingers there and on the open table, on the same scenes, and why it
fails; `--picture FILE.png` draws the first scene:

python examples/own_place.py
"""

import pregrasp_jax  # noqa: F401  (before jax, which reads then how many threads it may have)

# isort: split
import dataclasses
import functools
import math
from pathlib import Path

import jax
import jax.numpy as jnp
import tyro

from pregrasp_jax import drawing
from pregrasp_jax.config import Config, SceneConfig
from pregrasp_jax.evaluation import EvaluationResult, evaluate_policy
from pregrasp_jax.policies.scripts import make_clear
from pregrasp_jax.report.play import env_hulls
from pregrasp_jax.spaces.workspace import WORKSPACES, Box, Workspace
from pregrasp_jax.task.assembly import make_env
from pregrasp_jax.task.env import Env

LEDGE = Workspace(
    name="ledge",
    low=(-0.25, -0.22),  # an object whose centre of mass passes here has left
    high=(0.25, math.inf),  # the wall keeps it
    walls=(Box(center=(0.0, 0.26, 0.06), half_size=(0.25, 0.014, 0.06)),),
)
"""m. Walls collide with objects and fingers; pushes that bring the arm too near to one are unreachable."""

WORKSPACES[LEDGE.name] = LEDGE


def make_place(config: Config, name: str) -> Env:
    """Return the test scenes in the place called `name`."""
    return make_env(dataclasses.replace(config, task=dataclasses.replace(config.task, workspace=name)), split="test")


def draw(env: Env, path: Path) -> None:
    """Write a view of the first scene."""
    state = jax.jit(env.reset_to)(jnp.int32(0))
    hulls = jax.jit(functools.partial(env_hulls, env))(state)
    view = drawing.draw_camera(hulls, target_slot=int(state.scene.target))
    drawing.save_image(path, view)


def main(*, scenes: int = 50, num_envs: int = 16, picture: Path | None = None) -> dict[str, EvaluationResult]:
    """Evaluate `clear` in both places, without the grasp."""
    config = Config(scene=SceneConfig(test_scenes=scenes)).validate()
    envs, results = {name: make_place(config, name) for name in ("table", LEDGE.name)}, {}
    for name, env in envs.items():
        results[name] = evaluate_policy(env, make_clear(env), episodes=scenes, num_envs=num_envs, with_grasp=False)
        failures = results[name].failures or "none"
        print(f"{name}: {results[name].success_rate:.0%} of {scenes} scenes, failures {failures}")
    if picture:
        draw(envs[LEDGE.name], picture)
    return results


if __name__ == "__main__":
    tyro.cli(main)
