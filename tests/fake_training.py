"""Trainings in the world without physics, with a network that compiles in no time."""

import dataclasses
import functools
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TextIO

import flax.linen as nn
import jax
import jax.numpy as jnp
from fake_env import ACTIONS, FakeEnv

from pregrasp_jax.config import Config
from pregrasp_jax.learning.q_function import QFunction
from pregrasp_jax.presets import PRESETS
from pregrasp_jax.settings import to_dict
from pregrasp_jax.spaces import grid
from pregrasp_jax.task.primitive import Plan
from pregrasp_jax.training import program, session
from pregrasp_jax.training.console import Console
from pregrasp_jax.training.dump import make_dump
from pregrasp_jax.training.run_folder import RunFolder
from pregrasp_jax.training.trainer import Trainer
from pregrasp_jax.types import MAX_OBJECTS, EnvState, Observation, StepResult

TIME = "time/"


@dataclasses.dataclass(frozen=True)
class PictureEnv(FakeEnv):
    """The fake world with random resets, and pictures that say where everything is."""

    def reset(self, key: jax.Array) -> EnvState:
        return self._draw(self.reset_to(jax.random.randint(key, (), 0, len(self.scenes))))

    def conclude(self, state: EnvState, plan: Plan, physics: Any) -> tuple[EnvState, StepResult]:
        next_state, result = super().conclude(state, plan, physics)
        return self._draw(next_state), result

    def _draw(self, state: EnvState) -> EnvState:
        points = jnp.concatenate([state.centroids[:, :2], state.hand.xy[None]])
        row, col = grid.world_to_cell(points)
        ids = jnp.arange(1, MAX_OBJECTS + 2).astype(jnp.uint8)
        blank = jnp.zeros((grid.GRID_SIZE, grid.GRID_SIZE), jnp.uint8)
        height, instance_ids = (blank.at[row, col].set(x, mode="drop") for x in (100 + ids, ids))
        return state.replace(obs=Observation(height, instance_ids, state.hand))


def make_config(**train: Any) -> Config:
    values = to_dict(PRESETS["ci"])
    values["train"] |= {"num_envs": 3, "minutes": 0.0, "episodes": 12, "log_every": 6} | train
    values["learner"] |= {"warmup": 9, "updates_per_step": 0.25, "batch_size": 2}
    values["replay"] |= {"capacity": 70}
    values["network"]["width"] = 1.0
    return Config.from_dict(values).validate()


def input_fn(obs: Observation, target: jax.Array) -> jax.Array:
    target_pixel = (obs.instance_ids == target + 1).astype(jnp.float32)
    return jnp.stack([obs.height.astype(jnp.float32) / 255, target_pixel], axis=-1)


class TinyNetwork(nn.Module):
    """One convolution: compiles in no time."""

    width: float = 1.0

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        return nn.Conv(2, (round(3 * self.width),) * 2, name="conv")(x)

    def q_at(self, x: jax.Array, row: jax.Array, col: jax.Array) -> jax.Array:
        return self(x)[jnp.arange(x.shape[0]), row, col]


def make_program(config: Config, env: Any = None, **options: Any) -> program.Program:
    q_function = QFunction(
        TinyNetwork(width=config.network.width), ACTIONS, input_fn, members=config.network.num_members
    )
    scenes: Any = env or PictureEnv()
    return program.make_program(scenes, config, q_function=q_function, **options)


class CompiledOnce(program.Program):
    """A program that remembers what it was compiled to: many tests train by the same settings."""

    @functools.cached_property
    def compiled(self) -> program.Program:
        return super().compile(self.shapes())

    def compile(self, state: program.TrainState) -> program.Program:
        return self.compiled


@functools.lru_cache(maxsize=4)
def shared_program(config: Config) -> program.Program:
    """Return the program of the world without physics for a configuration, the same every time."""
    return CompiledOnce(**vars(make_program(config)))


def evaluate(params: Any) -> dict[str, Any]:
    return {"success_rate": 0.25, "mean_motions": None}


def stop_after(steps: int) -> Callable[[], bool]:
    """Stand for a signal that comes after a number of steps."""
    left = iter(range(steps))
    return lambda: next(left, None) is None


def never() -> bool:
    return False


def make_trainer(
    path: Path,
    config: Config,
    *,
    resume: bool = False,
    said: TextIO | None = None,
    env: Any = None,
    folder: RunFolder | None = None,
) -> Trainer:
    built = make_program(config, env) if env else shared_program(config)
    env = env or PictureEnv()
    folder = folder or (RunFolder.open(path, config) if resume else RunFolder.create(path, config))
    dump, console = make_dump(env, config), Console(said or io.StringIO())
    return session.make_trainer(config, folder, built, evaluate, dump, console, resumed=folder.has_checkpoint)


def run(path: Path, config: Config, *, stop: Callable[[], bool] = never, **options: Any) -> Trainer:
    trainer = make_trainer(path, config, **options)
    with trainer.recorder.folder:
        trainer.run(stop)
    return trainer


def rows(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (path / "metrics.jsonl").read_text().splitlines()]


def timeless(path: Path) -> list[dict[str, Any]]:
    return [{k: v for k, v in row.items() if not k.startswith(TIME)} for row in rows(path)]
