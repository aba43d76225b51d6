"""What one parameter of a search may be, and how settings are drawn from several of them."""

import itertools
import math
import random
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

DIGITS = 4
"""Significant digits of drawn numbers, so that they can be typed again."""


@dataclass(frozen=True)
class Parameter:
    """A parameter: values to choose from, or a range.

    Attributes:
        kind: `values`, `uniform`, `log` or `int`.
        given: the values, or the two ends, which belong to it.
    """

    kind: str
    given: tuple[Any, ...]

    def draw(self, generator: random.Random) -> Any:
        """Return a value; numbers of a range have `DIGITS` digits."""
        return _DRAWS[self.kind](generator, *self.given) if self.kind != "values" else generator.choice(self.given)

    def corners(self) -> tuple[Any, ...]:
        """Return what must be allowed for all to be allowed: the values, or both ends."""
        return self.given

    def to_plain(self) -> dict[str, list[Any]]:
        """Return what `read_parameter` reads."""
        return {self.kind: list(self.given)}


def read_parameter(value: Any, key: str) -> Parameter:
    """Return a parameter such as ``{log: [1e-4, 1e-2]}``.

    Raises:
        ValueError: unknown kind, or ends or values that are none.
    """
    allowed = "{values: [..]}, {uniform: [low, high]}, {log: [low, high]} or {int: [low, high]}"
    if not isinstance(value, Mapping) or len(value) != 1 or next(iter(value)) not in ("values", *_DRAWS):
        raise ValueError(f"{key} = {value!r} is no parameter; allowed: {allowed}")
    ((kind, given),) = value.items()
    if not isinstance(given, list) or not given:
        raise ValueError(f"{key}.{kind} = {given!r} is no list; allowed: {allowed}")
    if kind == "values":
        if any(given.count(item) > 1 for item in given):
            raise ValueError(f"{key}.values = {given!r} has a value twice; allowed is each once")
    elif not _is_range(given, kind):
        raise ValueError(f"{key}.{kind} = {given!r} is no range; allowed: [low, high] with low < high{_MORE[kind]}")
    return Parameter(kind, tuple(given))


def grid(parameters: Mapping[str, Parameter], seed: int) -> list[dict[str, Any]]:
    """Return all combinations in a shuffled order: what is stopped early has then tried a bit of everything."""
    combinations = [
        dict(zip(parameters, values, strict=True))
        for values in itertools.product(*(parameter.given for parameter in parameters.values()))
    ]
    random.Random(seed).shuffle(combinations)
    return combinations


def draws(parameters: Mapping[str, Parameter], seed: int) -> Iterator[dict[str, Any]]:
    """Yield random settings without end."""
    generator = random.Random(seed)
    while True:
        yield {name: parameter.draw(generator) for name, parameter in parameters.items()}


def rounded(value: float, low: float, high: float) -> float:
    """Return a number with `DIGITS` digits, not outside of its range."""
    return min(max(float(f"{value:.{DIGITS}g}"), low), high)


def _uniform(generator: random.Random, low: float, high: float) -> float:
    return rounded(generator.uniform(low, high), low, high)


def _log(generator: random.Random, low: float, high: float) -> float:
    return rounded(math.exp(generator.uniform(math.log(low), math.log(high))), low, high)


_DRAWS: dict[str, Callable[..., Any]] = {"uniform": _uniform, "log": _log, "int": random.Random.randint}

_MORE = {"uniform": "", "log": ", both above 0", "int": ", whole numbers"}


def _is_range(given: list[Any], kind: str) -> bool:
    types = (int,) if kind == "int" else (int, float)
    if len(given) != 2 or any(type(end) not in types or not math.isfinite(end) for end in given):
        return False
    return given[0] < given[1] and (kind != "log" or given[0] > 0)
