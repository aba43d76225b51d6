"""Several networks as one: their parameters side by side, each under a name of its own.

A value is the mean of what they say. Where no push was tried their errors differ, so the mean is nearer to the truth,
and the maximum over thousands of pushes finds fewer that only seem to be good.
"""

from collections.abc import Sequence
from typing import Any

Params = Any


def join(networks: Sequence[Params]) -> Params:
    """Return the parameters of several networks as one tree; those of a single one stay as they are."""
    return networks[0] if len(networks) == 1 else {_name(index): params for index, params in enumerate(networks)}


def split(params: Params, members: int) -> list[Params]:
    """Return the parameters of each of so many networks; undoes `join`.

    Raises:
        ValueError: they are of fewer.
    """
    if members == 1:
        return [params]
    names = [_name(index) for index in range(members)]
    if missing := [name for name in names if name not in params]:
        raise ValueError(f"parameters of {members} networks are wanted; {missing[0]} is missing")
    return [params[name] for name in names]


def _name(index: int) -> str:
    return f"member{index}"
