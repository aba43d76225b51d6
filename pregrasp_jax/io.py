"""Files that are whole or absent, and hashes that say what made them. No other module of the package is needed."""

import contextlib
import errno
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, TextIO, cast

import numpy as np

PARTIAL = ".partial"
"""Ending of files that are being written."""

_OLD = "old"
"""Name of a folder that is put aside while another takes its place."""

_LONGEST_NAME = 255
"""Bytes, of one file or folder."""

CACHE = "PREGRASP_JAX_CACHE"
"""Environment variable that names the folder of rebuildable files."""


def cache_dir() -> Path:
    """Return the folder of rebuildable files: ``$PREGRASP_JAX_CACHE``, or ``pregrasp_jax`` in the user's cache.

    Raises:
        ValueError: neither is known; a container's user may have no home.
    """
    if folder := os.environ.get(CACHE):
        return Path(folder)
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "pregrasp_jax"
    except RuntimeError:
        raise ValueError(
            f"this user has no home folder that could hold a cache; allowed is to set {CACHE} to a folder that can be "
            "written"
        ) from None


def refuse_unwritable_cache(path: Path) -> None:
    """Do as `refuse_unwritable`, for a file in the cache: there is another place for that."""
    try:
        refuse_unwritable(path)
    except ValueError as error:
        raise ValueError(f"{error}; {CACHE} names another folder for the cache") from None


def mjcf_dir() -> Path:
    """Return the folder of the MJCF files: inside an installed package, or beside it in a source checkout.

    Raises:
        FileNotFoundError: neither place holds table.xml.
    """
    package = Path(__file__).resolve().parent
    places = (package / "mjcf", package.parent / "mjcf")
    for place in places:
        if (place / "table.xml").is_file():
            return place
    raise FileNotFoundError(f"table.xml is missing; looked in {places[0]} and {places[1]}")


def refuse_unwritable(path: Path) -> None:
    """Refuse a file or folder that could not be written, before hours of work are spent on its content.

    Raises:
        ValueError: its folder, or the nearest one that exists, does not allow writing, or its name is too long.
    """
    if (size := len(os.fsencode(path.name))) > _LONGEST_NAME:
        raise ValueError(
            f"{path.name[:32]}... cannot be written: its name has {size} bytes; allowed are {_LONGEST_NAME}"
        )
    if not is_writable(path):
        folder = _existing_parent(path)
        raise ValueError(f"{path} cannot be written: {folder} is not a writable folder; allowed is one that is")


def is_writable(path: Path) -> bool:
    """Return whether a file or folder could be made: its folder, or the nearest one that exists, allows writing."""
    folder = _existing_parent(path)
    return folder.is_dir() and os.access(folder, os.W_OK)


def refuse_ending(path: Path, endings: tuple[str, ...]) -> None:
    """Refuse a name whose ending promises something else than what would be written.

    Raises:
        ValueError: it has none of `endings`, in small letters or in capitals.
    """
    if path.suffix.lower() not in endings:
        raise ValueError(f"{path}: nothing can be written under this ending; allowed are {', '.join(endings)}")


def discard(stream: TextIO) -> None:
    """Let a stream whose reader has gone lead nowhere, so that what it still holds cannot fail either."""
    with contextlib.suppress(OSError, ValueError):  # not a stream of the system
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def write_atomic(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Let `write` fill a temporary file beside `path`, flush it to disk, then rename it over `path`.

    Raises:
        OSError: the disk is full or does not allow it; its `filename` is set.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(prefix=_hidden(path), suffix=PARTIAL, dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException as error:
        Path(temporary).unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno and not error.filename:
            error.filename = str(path)  # a full disk does not say which file it was
        raise


@contextlib.contextmanager
def staged_folder(folder: Path) -> Iterator[Path]:
    """Give an empty folder to write into; when that is done it takes the place of `folder` and of what is in there.

    After an error nothing has changed. A process that is killed leaves the old folder or the new one, whole; between
    two renames the old one has a hidden name beside its place.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=_hidden(folder), suffix=PARTIAL, dir=folder.parent) as beside:
        new, old = Path(beside, "new"), Path(beside, _OLD)
        new.mkdir()
        yield new
        try:
            if folder.is_dir():
                folder.rename(old)
            new.rename(folder)
        except BaseException:
            if old.is_dir():
                old.rename(folder)
            raise


def _hidden(path: Path) -> str:
    """Return how the temporary name of a file or folder begins; as long as the name itself it could be too long."""
    return f".{path.name[:32]}."


def sweep(folder: Path) -> None:
    """Delete what writers that were killed have left anywhere under `folder`; nobody else may be writing there.

    A folder that `staged_folder` had put aside stays where it is: it may be all that there is of it.
    """
    for path in list(folder.rglob(f".*{PARTIAL}")):
        if not path.is_dir():
            path.unlink(missing_ok=True)
        elif not (path / _OLD).exists():
            shutil.rmtree(path)


def write_bytes(path: Path, data: bytes) -> None:
    """Write `data` to `path` whole or not at all."""
    write_atomic(path, lambda file: file.write(data))


def write_json(path: Path, value: Any) -> None:
    """Write `value` as indented JSON, whole or not at all."""
    write_bytes(path, (json.dumps(value, indent=2, allow_nan=False) + "\n").encode())


def append_json_lines(path: Path, *values: Any) -> None:
    """Append values as lines of JSON, all of them whole or nothing at all.

    Raises:
        OSError: the disk is full.
    """
    data = "".join(json.dumps(value, allow_nan=False) + "\n" for value in values).encode()
    with path.open("ab", buffering=0) as file:
        length = file.tell()
        if file.write(data) < len(data):  # what a full disk does at first; only the next write raises
            file.truncate(length)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), file.name)


def write_npz(path: Path, **arrays: np.ndarray) -> None:
    """Write arrays as a compressed npz, whole or not at all."""
    write_atomic(path, lambda file: np.savez_compressed(file, **cast(Any, arrays)))


def content_hash(*parts: Any) -> str:
    """Return 16 hex digits of the SHA-256 of arrays (dtype, shape, bytes), bytes, and JSON-able values, in order."""
    digest = hashlib.sha256()
    for part in parts:
        if hasattr(part, "__array__"):
            array = np.ascontiguousarray(part)
            digest.update(f"{array.dtype.str}{array.shape}".encode())
            digest.update(array.tobytes())
        elif isinstance(part, bytes):
            digest.update(part)
        else:
            digest.update(json.dumps(part, sort_keys=True).encode())
    return digest.hexdigest()[:16]


def _existing_parent(path: Path) -> Path:
    return next(parent for parent in path.absolute().parents if parent.exists())
