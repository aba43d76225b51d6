"""What a user reads when something is wrong: one line that says what is allowed."""

import shlex
from collections.abc import Mapping
from typing import TypeVar

T = TypeVar("T")


def one_line(said: object) -> str:
    """Return an error or a text on one line; what says nothing is called by the name of its type."""
    return " ".join(str(said).split()) or type(said).__name__


def command(*words: object) -> str:
    """Return a line of this program that can be typed as it stands."""
    return shlex.join(["pregrasp-jax", *map(str, words)])


def lookup(table: Mapping[str, T], name: str, *, key: str) -> T:
    """Return the entry of a table that a user may add to.

    Args:
        table: by name.
        name: as the user wrote it.
        key: the setting it was written for.

    Raises:
        ValueError: there is no such entry; the line lists those that exist.
    """
    if name not in table:
        raise ValueError(f"{key} = {name!r} does not exist; allowed: {', '.join(sorted(table))}")
    return table[name]
