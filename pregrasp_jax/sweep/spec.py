"""What a sweep is: one YAML, read strictly, in which settings have the dotted names of the command line."""

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from pregrasp_jax import yaml_file
from pregrasp_jax.messages import lookup
from pregrasp_jax.presets import PRESETS
from pregrasp_jax.settings import from_dict
from pregrasp_jax.sweep.parameters import Parameter, read_parameter

PROGRAM = (sys.executable, "-m", "pregrasp_jax")
"""What trains and evaluates unless a spec names another program."""


@dataclass(frozen=True, kw_only=True)
class Search:
    """Which settings are tried."""

    method: Literal["grid", "random", "tpe"] = "grid"
    """`grid` takes all combinations, in shuffled order; `random` draws; `tpe` learns from what was measured."""
    trials: int | None = None
    """Settings to try; a grid has its own number."""
    seed: int = 0
    """Of the order, or of the draws."""


@dataclass(frozen=True, kw_only=True)
class Stop:
    """Which settings are given up early."""

    method: Literal["none", "halving"] = "none"
    metric: str = "eval/success_rate"
    """Measured on validation scenes; more is better. Also ranks the table."""
    rungs: tuple[int, ...] = ()
    """Env steps after which all wait for each other, and the worse ones stop."""
    keep: float = 0.5
    """Share of the settings that goes on."""


@dataclass(frozen=True, kw_only=True)
class Resources:
    """What one trial gets."""

    cores: int = 1
    memory_gb: float | None = None
    """None estimates it from the size of the replay."""
    gpu: float = 0.0
    """GPUs; 0.25 puts four trials on each."""


@dataclass(frozen=True, kw_only=True)
class Final:
    """The best settings again, with fresh seeds, on test scenes; no seeds: not done."""

    seeds: tuple[int, ...] = ()
    top: int = 1
    """Settings that are trained again; two or more are compared in pairs."""
    episodes: int = 200
    """Test scenes for each, unless `tests` names others."""


@dataclass(frozen=True, kw_only=True)
class Variant:
    """A named setting.

    Attributes:
        settings: dotted name -> value, beside those of all trials.
        policy: who is evaluated without a training; None trains.
        init_from: whose parameters the training begins with.
    """

    settings: Mapping[str, Any] = field(default_factory=dict)
    policy: str | None = None
    init_from: str | None = None


@dataclass(frozen=True, kw_only=True)
class Spec:
    """A sweep.

    Attributes:
        preset: what every trial begins with.
        set: dotted name -> value for all trials.
        parameters: what is searched, by dotted name.
        variants: named settings, instead of `parameters`.
        seeds: every setting is trained with all of them.
        search: see there, and so the next.
        stop: halving.
        resources: of one trial.
        final: the end of the sweep.
        tests: evaluations of every finished trial: name -> dotted options of `evaluate`.
        slurm: options of sbatch beside those that follow from the resources.
        program: what is called instead of `python -m pregrasp_jax`.
    """

    preset: str
    set: Mapping[str, Any] = field(default_factory=dict)
    parameters: Mapping[str, Parameter] = field(default_factory=dict)
    variants: Mapping[str, Variant] = field(default_factory=dict)
    seeds: tuple[int, ...] = (0,)
    search: Search = field(default_factory=Search)
    stop: Stop = field(default_factory=Stop)
    resources: Resources = field(default_factory=Resources)
    final: Final = field(default_factory=Final)
    tests: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    slurm: Mapping[str, Any] = field(default_factory=dict)
    program: tuple[str, ...] = PROGRAM


def read_spec(path: Path) -> Spec:
    """Read the YAML of a sweep; `checks.check` says whether it can be run.

    Raises:
        ValueError: not YAML, a key that is unknown or stands twice, or a value of the wrong type.
    """
    values = yaml_file.read(path)
    try:
        return spec_from(values)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def spec_from(values: Any) -> Spec:
    """Return the sweep that nested plain data describe.

    Raises:
        ValueError: as `read_spec`.
    """
    given = _mapping(values, "a sweep")
    _refuse_unknown(given, ["preset", *_READERS], "")
    if "preset" not in given:
        raise ValueError(f"preset is missing; allowed: {', '.join(PRESETS)}")
    lookup(PRESETS, str(given["preset"]), key="preset")
    fields = {key: _READERS[key](value, key) for key, value in given.items() if key != "preset"}
    return Spec(preset=given["preset"], **fields)


def _section(cls: type, *lists: str) -> Callable[[Any, str], Any]:
    """Return the reader of a section of scalars, and of `lists` of whole numbers."""

    def read(value: Any, key: str) -> Any:
        section = dict(_mapping(value, key))
        several = {name: _numbers(section.pop(name), f"{key}.{name}") for name in lists if name in section}
        known = [name for name in cls.__dataclass_fields__ if name not in lists]
        _refuse_unknown(section, [*known, *lists], f"{key}.")
        scalars = from_dict(section, cls, f"{key}.")
        return cls(**{name: getattr(scalars, name) for name in known}, **several)

    return read


def _variants(value: Any, key: str) -> dict[str, Variant]:
    found = {}
    for name, given in _mapping(value, key).items():
        settings = dict(_mapping({} if given is None else given, f"{key}.{name}"))
        special = {word: settings.pop(word, None) for word in ("policy", "init_from")}
        for word, text in special.items():
            if text is not None and not isinstance(text, str):
                raise ValueError(f"{key}.{name}.{word} = {text!r} has the wrong type; allowed: text")
        found[str(name)] = Variant(settings=settings, **special)
    return found


def _named_settings(value: Any, key: str) -> dict[str, Mapping[str, Any]]:
    return {str(name): _mapping({} if v is None else v, f"{key}.{name}") for name, v in _mapping(value, key).items()}


def _parameters(value: Any, key: str) -> dict[str, Parameter]:
    return {name: read_parameter(given, f"{key}.{name}") for name, given in _mapping(value, key).items()}


def _mapping(value: Any, key: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise ValueError(f"{key} must be a mapping, got {type(value).__name__}")
    if odd := [name for name in value if not isinstance(name, str)]:
        raise ValueError(f"{key} has the key {odd[0]!r}; allowed is text")
    return value


def _numbers(value: Any, key: str) -> tuple[int, ...]:
    if not isinstance(value, list) or not all(type(item) is int and item >= 0 for item in value):
        raise ValueError(f"{key} = {value!r} is no list of whole numbers from 0 on")
    if len(set(value)) < len(value):
        raise ValueError(f"{key} = {value!r} has a number twice; allowed is each once")
    return tuple(value)


def _words(value: Any, key: str) -> tuple[str, ...]:
    if not isinstance(value, list) or not value or not all(isinstance(item, str) for item in value):
        raise ValueError(f"{key} = {value!r} is no list of words, such as [python, own_hand.py]")
    return tuple(value)


def _refuse_unknown(given: Mapping[str, Any], allowed: Sequence[str], prefix: str) -> None:
    if unknown := [key for key in given if key not in allowed]:
        raise ValueError(f"unknown key {prefix}{unknown[0]}; allowed here: {', '.join(sorted(allowed))}")


_READERS: dict[str, Callable[[Any, str], Any]] = {
    "set": _mapping,
    "parameters": _parameters,
    "variants": _variants,
    "seeds": _numbers,
    "search": _section(Search),
    "stop": _section(Stop, "rungs"),
    "resources": _section(Resources),
    "final": _section(Final, "seeds"),
    "tests": _named_settings,
    "slurm": _mapping,
    "program": _words,
}


def to_plain(spec: Spec) -> dict[str, Any]:
    """Return plain data that `spec_from` gives back, without what is as it would be anyway."""
    empty = Spec(preset=spec.preset)
    plain: dict[str, Any] = {"preset": spec.preset}
    for key in _READERS:
        value = getattr(spec, key)
        if value != getattr(empty, key):
            plain[key] = _plain(value)
    return plain


def _plain(value: Any) -> Any:
    if isinstance(value, Parameter):
        return value.to_plain()
    if isinstance(value, Variant):
        special = {"policy": value.policy, "init_from": value.init_from}
        return dict(value.settings) | {word: text for word, text in special.items() if text is not None}
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, tuple):
        return list(value)
    if hasattr(value, "__dataclass_fields__"):
        pairs = ((name, _plain(getattr(value, name))) for name in value.__dataclass_fields__)
        return {name: item for name, item in pairs if item is not None and item != []}
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{value} is no value of a setting")
    return value
