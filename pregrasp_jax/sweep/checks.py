"""Everything that can be known to be wrong before the first trial starts, one line each."""

import dataclasses
import itertools
import math
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pregrasp_jax.config import PUSHING, Config
from pregrasp_jax.evaluation_config import EvaluationConfig, environment_config, refuse_other_hand
from pregrasp_jax.ranges import RANGES
from pregrasp_jax.sensors import SENSORS, camera_sensor
from pregrasp_jax.settings import from_dict, to_dict
from pregrasp_jax.spaces.workspace import get_workspace
from pregrasp_jax.sweep import parameters
from pregrasp_jax.sweep.spec import PROGRAM, Final, Spec, Stop, Variant
from pregrasp_jax.sweep.trials import trial_config

GIVEN = {"seed": "seeds", "physics.threads": "resources.cores"}
"""Settings that other keys of a sweep decide."""

METRICS = ("success_rate", "in_region_rate", "lenient_rate", "mean_return")
"""What trainings measure on validation scenes of which more is better."""

_TEST_NAME = re.compile(r"[^/.\0][^/\0]{0,99}")
"""It becomes part of the name of a file."""

LIMITS = ("train.env_steps", "train.episodes", "train.minutes")

Setting = tuple[Mapping[str, Any], Mapping[str, Any]]
"""What varies, and what else `trials.make_trial` must know."""


def settings_of(spec: Spec) -> list[Setting] | None:
    """Return the settings of a sweep in order; None if they are found on the way."""
    if spec.variants:
        return [
            (variant.settings, {"name": name, "policy": variant.policy, "init_from": variant.init_from})
            for name, variant in spec.variants.items()
        ]
    if spec.search.method == "grid":
        return [(setting, {}) for setting in parameters.grid(spec.parameters, spec.search.seed)]
    if spec.search.method == "tpe":
        return None
    return [(setting, {}) for setting in _different(spec)]


def check(spec: Spec, *, here: Path = Path()) -> None:
    """Refuse a sweep that cannot run as it is meant.

    Args:
        spec: of the sweep.
        here: folder that relative paths refer to.

    Raises:
        ValueError: one line says what, where, and what is allowed.
    """
    problems = (_search(spec), _names(spec, here), _stop(spec), _resources(spec), _final(spec), _program(spec, here))
    for problem in itertools.chain(*problems):
        raise ValueError(problem)
    for varied, about in settings_to_check(spec):
        if about.get("policy") is None:
            _check_setting(spec, varied, here)
    for name, options in spec.tests.items():
        _check_test(spec, name, options, here)


def settings_to_check(spec: Spec) -> list[Setting]:
    """Return settings such that all of the sweep are allowed if these are."""
    known = settings_of(spec)
    if known is not None:
        return known
    middle = {name: parameter.given[0] for name, parameter in spec.parameters.items()}
    corners = ((name, value) for name, parameter in spec.parameters.items() for value in parameter.corners())
    return [(middle | {name: value}, {}) for name, value in corners]


def num_settings(spec: Spec) -> int:
    """Return how many settings there will be."""
    known = settings_of(spec)
    return len(known) if known is not None else spec.search.trials or 0


def _search(spec: Spec) -> Iterator[str]:
    search = spec.search
    if not spec.seeds:
        yield "seeds is empty; allowed is a list such as [0, 1]"
    yield from _seeds("seeds", spec.seeds)
    if spec.variants and (spec.parameters or search.method != "grid"):
        yield "variants are not searched; allowed is either variants, or parameters and search"
    if search.method == "grid" and search.trials is not None:
        yield "search.trials: a grid tries all combinations; allowed is to leave it out, or random or tpe"
    ranges = [name for name, parameter in spec.parameters.items() if parameter.kind != "values"]
    if search.method == "grid" and ranges:
        yield f"parameters.{ranges[0]} is a range, which a grid cannot try; allowed: values, or method random or tpe"
    if search.method != "grid" and (not spec.parameters or (search.trials or 0) < 1):
        yield f"search.method {search.method} needs parameters, and search.trials of 1 and more"
    if search.method == "random" and spec.parameters and len(_different(spec)) < (search.trials or 0):
        yield f"search.trials = {search.trials}, but there are only {len(_different(spec))} settings to draw"


def _names(spec: Spec, here: Path) -> Iterator[str]:
    if doubled := sorted(set(spec.set) & set(spec.parameters)):
        yield f"{doubled[0]} stands in set and in parameters; allowed is one of them"
    varied = (variant.settings for variant in spec.variants.values())
    for name in itertools.chain(spec.set, spec.parameters, *varied):
        if name in GIVEN:
            yield f"{name} is decided by {GIVEN[name]}; allowed is that"
    seen: list[Variant] = []
    for name, variant in spec.variants.items():
        if variant in seen:
            twin = list(spec.variants)[seen.index(variant)]
            yield f"variants.{name} is the same as variants.{twin}; allowed is each setting once"
        seen.append(variant)
        if variant.policy is not None and (variant.settings or variant.init_from):
            yield f"variants.{name} names a policy, which is not trained; allowed beside it is nothing"
        start = variant.init_from
        if start is not None and start not in PUSHING and not (here / start).exists():
            yield f"variants.{name}.init_from = {start!r} does not exist; allowed: pretrained, a run or a policy folder"


def _stop(spec: Spec) -> Iterator[str]:
    stop = spec.stop
    if not stop.metric.startswith("eval/"):
        yield f"stop.metric = {stop.metric!r} is not of validation scenes; allowed: eval/success_rate and others"
    elif spec.program == PROGRAM and stop.metric.removeprefix("eval/") not in METRICS:
        yield f"stop.metric = {stop.metric!r} is not known; allowed: eval/{', eval/'.join(METRICS)}"
    if stop.method == "none":
        if stop.rungs:
            yield "stop.rungs belong to stop.method halving"
        if stop.keep != Stop().keep:
            yield "stop.keep belongs to stop.method halving"
        return
    if not stop.rungs or list(stop.rungs) != sorted(stop.rungs) or stop.rungs[0] < 1:
        yield f"stop.rungs = {list(stop.rungs)} must be env steps above 0 in ascending order, one and more"
    if not 0 < stop.keep < 1:
        yield f"stop.keep = {stop.keep} is out of range; allowed is between 0 and 1"
    if spec.search.method == "tpe":
        yield "stop.method halving compares settings that are known at the start; allowed with search.method tpe: none"
    if num_settings(spec) - sum(variant.policy is not None for variant in spec.variants.values()) < 2:
        yield "stop.method halving needs two settings that are trained, and more"
    varied = {
        name for settings in [spec.parameters, *(v.settings for v in spec.variants.values())] for name in settings
    }
    if limits := [name for name in LIMITS if name in varied]:
        yield f"{limits[0]} may change when a run goes on, so halving cannot compare it; allowed is one value in set"


def _resources(spec: Spec) -> Iterator[str]:
    resources = spec.resources
    if resources.cores < 1:
        yield f"resources.cores = {resources.cores} is out of range; allowed is 1 and more"
    if resources.memory_gb is not None and not 0 < resources.memory_gb < math.inf:
        yield f"resources.memory_gb = {resources.memory_gb} is out of range; allowed is above 0, or null"
    if not 0 <= resources.gpu < math.inf or (resources.gpu > 1 and not resources.gpu.is_integer()):
        yield f"resources.gpu = {resources.gpu} is out of range; allowed is a share up to 1, or a whole number"


def _final(spec: Spec) -> Iterator[str]:
    final = spec.final
    if used := sorted(set(final.seeds) & set(spec.seeds)):
        yield f"final.seeds has {used[0]}, with which settings were chosen; allowed are others than {list(spec.seeds)}"
    for name in ("top", "episodes"):
        if getattr(final, name) < 1:
            yield f"final.{name} = {getattr(final, name)} is out of range; allowed is 1 and more"
    if not final.seeds and final != Final():
        yield "final has no seeds, so nothing is trained again; allowed beside that is nothing"
    yield from _seeds("final.seeds", final.seeds)
    trained = num_settings(spec) - sum(variant.policy is not None for variant in spec.variants.values())
    if final.seeds and final.top > trained:
        yield f"final.top = {final.top}, but {trained} settings are trained; allowed is at most that"


def _seeds(key: str, seeds: Sequence[int]) -> Iterator[str]:
    low, high = RANGES["seed"]
    if wrong := [seed for seed in seeds if not low <= seed <= high]:
        yield f"{key} has {wrong[0]}, which is out of range; allowed is {low} to {high}"


def _program(spec: Spec, here: Path) -> Iterator[str]:
    name = spec.program[0] if spec.program else ""
    if not (shutil.which(name) or shutil.which(here / name)):
        yield f"program = {list(spec.program)}: {name!r} is not found; allowed is one that can be run, with its options"


def _check_setting(spec: Spec, varied: Mapping[str, Any], here: Path) -> None:
    config = trial_config(spec, {**spec.set, **varied})
    _check_places(spec, config, here)
    if spec.stop.method == "none":
        return
    every, rungs = config.train.evaluate_every, spec.stop.rungs
    if not every or any(rung % every for rung in rungs):
        raise ValueError(
            f"stop.rungs = {list(rungs)} look at evaluations; allowed are multiples of train.evaluate_every = {every}"
        )
    if config.train.env_steps <= rungs[-1]:
        raise ValueError(
            f"stop.rungs end at {rungs[-1]}; halving needs train.env_steps above that, the length of a whole run, so "
            f"that schedules are those of a whole run; it is {config.train.env_steps}"
        )


def _check_places(spec: Spec, config: Config, here: Path) -> None:
    """Refuse meshes, sensors and places that are not there, or not for this task."""
    folder, sensor = config.assets.object_dir, config.task.sensor
    if folder is not None and not (here / folder).is_dir():
        raise ValueError(f"assets.object_dir = {folder!r} is no folder; allowed is one with meshes")
    camera_sensor(sensor if sensor in SENSORS else str(here / sensor), config.task.camera)
    if spec.program == PROGRAM:  # another program may bring places of its own
        get_workspace(config.task.workspace, dataclasses.asdict(config.task.place))


def _check_test(spec: Spec, name: str, options: Mapping[str, Any], here: Path) -> None:
    """Refuse options that `evaluate` does not have or refuses, and places that are not there."""
    if not _TEST_NAME.fullmatch(name):
        raise ValueError(
            f"tests has {name!r}, which is to name a file; allowed is a short name without / and a dot at its start"
        )
    values = to_dict(EvaluationConfig(policy=""))
    for key, value in options.items():
        if key in ("policy", "physics.threads"):
            raise ValueError(f"tests.{name}.{key} is decided by the trial")
        *stages, last = key.split(".")
        section: Any = values
        for stage in stages:
            section = section.get(stage) if isinstance(section, dict) else None
        if not isinstance(section, dict) or last not in section or isinstance(section[last], dict):
            near = section if isinstance(section, dict) else values
            raise ValueError(f"tests.{name}: this version's evaluate knows no {key}; allowed here: {', '.join(near)}")
        section[last] = value
    checked = from_dict(values, EvaluationConfig, f"tests.{name}.")
    try:
        checked.validate()
        for varied, about in settings_to_check(spec):
            if about.get("policy") is None:
                trained = trial_config(spec, {**spec.set, **varied})
                tested = environment_config(checked, trained)
                refuse_other_hand(tested, trained)
                _check_places(spec, tested, here)
    except ValueError as error:
        raise ValueError(f"tests.{name}: {error}") from None


def _different(spec: Spec) -> list[dict[str, Any]]:
    """Return as many different random settings as are wanted, fewer if hundreds of draws in a row bring none."""
    found: list[dict[str, Any]] = []
    wanted, fruitless = spec.search.trials or 0, 0
    for setting in parameters.draws(spec.parameters, spec.search.seed):
        if len(found) >= wanted or fruitless > 500:
            break
        fruitless = fruitless + 1 if setting in found else 0
        if not fruitless:
            found.append(setting)
    return found
