"""From a configuration to an environment: objects, scenes, an engine, and the task between them."""

import dataclasses

import jax
import numpy as np

from pregrasp_jax import startup
from pregrasp_jax.assets import spread
from pregrasp_jax.assets.bank import concatenate
from pregrasp_jax.assets.sets import load_bank_for
from pregrasp_jax.assets.variants import MakingProgress, variant_bank
from pregrasp_jax.config import Config, TaskConfig
from pregrasp_jax.physics import make_engine
from pregrasp_jax.robot import closing_region, get_robot
from pregrasp_jax.robot.base import Robot
from pregrasp_jax.scene import bank as scene_bank
from pregrasp_jax.scene.bank import SPLITS, SceneBank, Split
from pregrasp_jax.sensors import CLEAN, Sensor, camera_sensor
from pregrasp_jax.spaces.workspace import Workspace
from pregrasp_jax.task import registry
from pregrasp_jax.task.env import Env
from pregrasp_jax.task.place import place_of, refuse_blocked, refuse_scenes, refuse_walls
from pregrasp_jax.task.primitive import Primitive
from pregrasp_jax.task.rules import Rules
from pregrasp_jax.types import HullBank


def make_env(
    config: Config,
    *,
    split: Split,
    threads: int | None = None,
    progress: scene_bank.PackingProgress | None = None,
    making: MakingProgress | None = None,
) -> Env:
    """Load the objects, load or pack the scenes of a split, and compile an engine of this environment's own.

    Args:
        config: the run's configuration.
        split: `train`, `validation` or `test`.
        threads: overrides `config.physics.threads`.
        progress: told about scenes packed so far, if any must be packed.
        making: told about objects made so far, if any must be made.

    Raises:
        ValueError: the objects or settings cannot be used; one line says why.
    """
    startup.check()
    threads = config.physics.threads if threads is None else threads
    refuse_walls(get_robot(config.task.robot), place_of(config.task))
    registry.get_kind(config.task.primitive)  # before anything is packed
    camera_sensor(config.task.sensor, config.task.camera)
    bank = load_split_bank(config, split, making=making)
    eligible = eligible_targets(get_robot(config.task.robot), bank, origin=str(config.assets.object_dir or "built in"))
    scenes = scene_bank.load_or_build(bank, eligible, config.scene, split, threads=threads, progress=progress)
    refuse_scenes(place_of(config.task), scenes)
    env = assemble(config, bank, scenes, eligible=eligible, threads=threads)
    refuse_blocked(env.robot, env.workspace, env.primitive, mirrored=config.task.mirrored_start)
    if split == "train" and config.train.tight_targets != 1:
        return dataclasses.replace(env, target_weights=_target_weights(env, config.train.tight_targets))
    return env


def _target_weights(env: Env, tight: float) -> np.ndarray:
    """Return how likely objects [N] become targets; see `TrainConfig.tight_targets`."""
    if env.robot.closing_region is None:
        raise ValueError(
            f"train.tight_targets = {tight:g}: the hand of robot {env.robot.name} has no closing region; allowed is 1"
        )
    region = jax.device_get(env.robot.closing_region(env.robot.start.aperture))
    return tight + (1 - tight) * closing_region.fitting_yaws(env.bank, region)


def load_split_bank(config: Config, split: Split, *, making: MakingProgress | None = None) -> HullBank:
    """Return the objects of a split: those of the set, and with `assets.variants` what is made beside them.

    Training meets both. Validation and test meet made objects only, others than training does, so that a run is judged
    by shapes that it has not seen without looking at any set that is reported.

    Args:
        config: the run's configuration.
        split: `train`, `validation` or `test`.
        making: told about objects made so far, if any must be made.

    Raises:
        ValueError: the objects cannot be used.
    """
    assets = config.assets
    known = load_bank_for(assets.object_dir, assets.object_set)
    if not assets.variants:
        return known
    made = variant_bank(known, assets.variants, seed=(config.scene.bank_seed, SPLITS.index(split)), progress=making)
    return concatenate([known, made]) if split == "train" else made


def assemble(
    config: Config, bank: HullBank, scenes: SceneBank, *, eligible: np.ndarray | None = None, threads: int = 0
) -> Env:
    """Return the environment of a configuration for objects and scenes at hand; see `make_env`.

    Args:
        config: the run's configuration.
        bank: the objects.
        scenes: the packed scenes of one split.
        eligible: [N] bool, from `eligible_targets`, where that is known.
        threads: of the native engine; 0 takes every core.
    """
    robot, workspace = get_robot(config.task.robot), place_of(config.task)
    refuse_walls(robot, workspace)
    eligible = eligible_targets(robot, bank) if eligible is None else eligible
    reach, sensor, num_variants = longest_push(config), camera_sensor(config.task.sensor, config.task.camera), 1
    if _spread(sensor) != _spread(CLEAN):
        mass_spread, friction_spread = _spread(sensor)
        bank = spread.vary(bank, mass_spread=mass_spread, friction_spread=friction_spread, seed=sensor.seed)
        num_variants, eligible = spread.NUM_VARIANTS, np.tile(eligible, spread.NUM_VARIANTS)
    parts = make_task(config.task, robot, workspace, bank, max_distance=reach)
    engines = registry.get_kind(config.task.primitive).engines
    engine = make_engine(config.physics.engine, bank, robot, workspace, threads=threads, engines=engines)
    return Env(config.task, workspace, robot, *parts, bank, eligible, scenes, engine, reach, sensor, num_variants)


def _spread(sensor: Sensor) -> tuple[float, float]:
    """Return how far objects differ from their models, in mass and in friction."""
    return sensor.mass_spread, sensor.friction_spread


def eligible_targets(robot: Robot, bank: HullBank, *, origin: str = "hull bank") -> np.ndarray:
    """Return which objects [N] bool a robot's hand can take.

    Args:
        robot: whose hand.
        bank: the objects.
        origin: where they come from, for the error.

    Raises:
        ValueError: none; the line says why the first one cannot be taken.
    """
    eligible, reasons = robot.eligibility(bank)
    if not eligible.any():
        raise ValueError(
            f"{origin}: none of {len(bank.names)} objects can be a target for robot {robot.name}; allowed is at least "
            f"1. The first: {bank.names[0]}: {reasons[0]}"
        )
    return eligible


def make_task(
    task: TaskConfig, robot: Robot, workspace: Workspace, bank: HullBank, *, max_distance: float
) -> tuple[Primitive, Rules]:
    """Return the primitive of a task and its rules.

    Raises:
        ValueError: there is no such primitive, the robot does not fit it, or no action is allowed at the start.
    """
    kind = registry.get_kind(task.primitive)
    primitive = kind.make_primitive(robot, workspace, task, max_distance=max_distance)
    if not np.any(primitive.mask(jax.tree.map(np.float32, robot.start))):
        x, y = robot.start.xy
        raise ValueError(
            f"task.r_in = {task.r_in} and task.r_out = {task.r_out} leave no cell of the workspace around the start "
            f"pose (x = {x:g} m, y = {y:g} m); allowed is a ring at least 0.01 m wide that reaches the workspace"
        )
    return primitive, kind.make_rules(robot, workspace, primitive, bank, task)


def longest_push(config: Config) -> float:
    """Return the length, m, of the longest push that is planned: unguided exploration goes anywhere at once."""
    return config.task.r_out if config.exploration.guided else float(np.hypot(0.5, 0.5) + 0.1)


def with_task(env: Env, **changes: object) -> Env:
    """Return the same scenes and engine under a changed task, for example another `r_out` or camera.

    Raises:
        ValueError: a robot, a place or a primitive that the engine was not made for, or a sensor under which the
            objects themselves would be others.
    """
    task = dataclasses.replace(env.task, **changes)  # pyright: ignore[reportArgumentType]
    for name in ("robot", "workspace", "place", "primitive"):
        if (asked := getattr(task, name)) != (made := getattr(env.task, name)):
            raise ValueError(f"task.{name} = {asked!r}, but these scenes are of {made!r}; allowed is `make_env`")
    sensor = camera_sensor(task.sensor, task.camera)
    if (_spread(sensor), sensor.seed) != (_spread(env.sensor), env.sensor.seed) and _spread(sensor) != _spread(CLEAN):
        raise ValueError(
            f"task.sensor = {task.sensor!r} has other objects than {env.task.sensor!r}; allowed is `make_env`"
        )
    reach = max(env.max_distance, task.r_out)
    primitive, rules = make_task(task, env.robot, env.workspace, env.bank, max_distance=reach)
    return dataclasses.replace(env, task=task, primitive=primitive, rules=rules, max_distance=reach, sensor=sensor)
