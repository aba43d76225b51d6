"""Files that a command line asks for: refused before the work if they could not be written as their names say."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Literal

from pregrasp_jax import drawing, io

Kind = Literal["image", "film", "json", "html"]

_NAME_CHECKS: dict[Kind, Callable[[Path], None]] = {
    "image": drawing.refuse_image,
    "film": drawing.refuse_film,
    "json": partial(io.refuse_ending, endings=(".json",)),
    "html": partial(io.refuse_ending, endings=(".html", ".htm")),
}


def refuse_unwritable(path: Path | None, kind: Kind) -> None:
    """Refuse a file that could not be written, before hours of work are spent on its content.

    Args:
        path: of the file, None if none is asked for.
        kind: what would be written to it.

    Raises:
        ValueError: its ending promises something else, it is a folder, or its folder does not allow writing.
    """
    if path is None:
        return
    if path.is_dir():
        raise ValueError(f"{path} is a folder; allowed is the name of a file")
    _NAME_CHECKS[kind](path)
    io.refuse_unwritable(path)
