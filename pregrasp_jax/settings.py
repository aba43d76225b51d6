"""Settings as frozen dataclasses: read from nested dicts, checked against ranges, compared.

Knows nothing of this project's settings: those are in `config`.
"""

import dataclasses
import operator
import types
import typing
from collections.abc import Mapping
from typing import Any, Literal


def check_ranges(config: Any, ranges: Mapping[str, tuple[float, float]], prefix: str = "") -> None:
    """Refuse a value of a config that is outside its range; ``None`` is in any.

    Raises:
        ValueError: one line names the key after `prefix`, the value and the range.
    """
    for key, (low, high) in ranges.items():
        value = operator.attrgetter(key)(config)
        if value is not None and not low <= value <= high:
            raise ValueError(f"{prefix}{key} = {value} is out of range; allowed is {low} to {high}")


def to_dict(config: Any) -> dict[str, Any]:
    """Return a config as nested plain dicts, ready for YAML or JSON."""
    return dataclasses.asdict(config)


def from_dict(values: Mapping[str, Any], cls: type, prefix: str = "") -> Any:
    """Build a dataclass from nested dicts.

    Args:
        values: by the names of fields.
        cls: the dataclass.
        prefix: of keys in messages, such as `train.`.

    Raises:
        ValueError: an unknown key or a value of the wrong type; one line names it and what is allowed.
    """
    if not isinstance(values, Mapping):
        raise ValueError(f"{prefix or 'config'} must be a mapping, got {type(values).__name__}")
    hints = typing.get_type_hints(cls)
    unknown = sorted(set(values) - set(hints), key=str)
    if unknown:
        raise ValueError(f"unknown config key {prefix}{unknown[0]}; allowed here: {', '.join(sorted(hints))}")
    required = [field.name for field in dataclasses.fields(cls) if _has_no_default(field)]
    if missing := [name for name in required if name not in values]:
        raise ValueError(f"config key {prefix}{missing[0]} is missing")
    return cls(**{name: _read(value, hints[name], f"{prefix}{name}") for name, value in values.items()})


def _has_no_default(field: dataclasses.Field[Any]) -> bool:
    return field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING


def _read(value: Any, hint: Any, key: str) -> Any:
    """Return a value as its type hint wants it: a dataclass, a tuple or a mapping of something, or a plain value."""
    if hint is Any:
        return value
    if dataclasses.is_dataclass(hint):
        return from_dict(value, typing.cast(type, hint), f"{key}.")
    if typing.get_origin(hint) is tuple:
        inner = typing.get_args(hint)
        if not isinstance(value, list | tuple) or (inner[-1] is not Ellipsis and len(value) != len(inner)):
            count = "" if inner[-1] is Ellipsis else f" of {len(inner)}"
            raise ValueError(f"{key} = {value!r} has the wrong type; allowed: a list{count}")
        return tuple(_read(item, inner[0], f"{key}[{index}]") for index, item in enumerate(value))
    if typing.get_origin(hint) is dict:
        if not isinstance(value, Mapping):
            raise ValueError(f"{key} = {value!r} has the wrong type; allowed: a mapping")
        return {name: _read(item, typing.get_args(hint)[1], f"{key}.{name}") for name, item in value.items()}
    nested = [
        option for option in typing.get_args(hint) if dataclasses.is_dataclass(option) or typing.get_origin(option)
    ]
    if len(nested) == 1 and isinstance(value, list | tuple | Mapping):
        return _read(value, nested[0], key)
    return _checked(value, hint, key)


def _checked(value: Any, hint: Any, key: str) -> Any:
    """Return `value` if it is of type `hint` (an int passes for a float)."""
    allowed = typing.get_args(hint) if typing.get_origin(hint) in (typing.Union, types.UnionType) else (hint,)
    words = [word for option in allowed if typing.get_origin(option) is Literal for word in typing.get_args(option)]
    if words and (value is not None or type(None) not in allowed):
        if not isinstance(value, typing.Hashable) or value not in words:
            raise ValueError(f"{key} = {value!r} is unknown; allowed: {', '.join(words)}")
        return value
    if float in allowed and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if type(value) not in allowed:
        names = " or ".join("null" if t is type(None) else t.__name__ for t in allowed)
        raise ValueError(f"{key} = {value!r} has the wrong type; allowed: {names}")
    return value


def difference(old: Any, new: Any) -> list[str]:
    """Return one line ``key: old -> new`` for every setting in which two configs differ."""
    flat_old, flat_new = flatten(to_dict(old)), flatten(to_dict(new))
    return [f"{key}: {flat_old[key]} -> {flat_new[key]}" for key in flat_old if flat_old[key] != flat_new[key]]


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested settings as one dict with keys such as ``task.r_out``."""
    flat = {}
    for key, value in values.items():
        flat |= flatten(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {prefix + key: value}
    return flat
