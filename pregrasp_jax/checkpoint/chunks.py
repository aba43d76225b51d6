"""The observation ring of the replay on disk, in append-only chunks.

Observation number n (counted from the start of the run) lives in slot n % capacity. A chunk holds the numbers
[start, stop) once and for all, so a checkpoint writes only what is new since the last one: heightmaps of
clutter shrink about tenfold under zlib, at some 150 MB/s.
"""

import hashlib
import io as bytes_io
import zipfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from pregrasp_jax import io
from pregrasp_jax.checkpoint.trees import DamagedFileError, leaf_names, rebuild

CHUNK_LENGTH = 2048
"""Observations per file at most: 40 MB before compression."""


class Chunk(NamedTuple):
    """One file of observations, as a checkpoint's manifest lists it.

    Attributes:
        start: number of the first observation.
        stop: number after the last one.
        sha256: of the file.
    """

    start: int
    stop: int
    sha256: str

    @property
    def name(self) -> str:
        """File name; the digits make the order of names the order of observations."""
        return f"{self.start:012d}-{self.stop:012d}.npz"


class Ring(NamedTuple):
    """A ring buffer to be saved.

    Attributes:
        contents: pytree of arrays [capacity, ...].
        written: observations ever written; number n is in slot n % capacity.
    """

    contents: Any
    written: int


def append(folder: Path, ring: Ring, known: list[Chunk]) -> list[Chunk]:
    """Write the live observations that no chunk in `known` holds.

    Returns:
        The chunks that together hold every live observation.
    """
    # np.asarray is a view on a CPU device; `named_leaves` would double a 1 GB ring.
    leaves = {
        name: np.asarray(leaf)
        for name, leaf in zip(leaf_names(ring.contents), jax.tree.leaves(ring.contents), strict=True)
    }
    capacity = next(iter(leaves.values())).shape[0]
    first = max(0, ring.written - capacity)
    kept = [c for c in known if first < c.stop <= ring.written and (folder / c.name).is_file()]
    return sorted(kept + [_write(folder, leaves, piece) for piece in _missing(first, ring.written, kept)])


def restore(folder: Path, template: Any, written: int, chunks: list[Chunk]) -> tuple[Any, np.ndarray, list[str]]:
    """Read the observations back.

    Returns:
        The contents of the ring, in fresh device arrays, 0 where they are lost or were never written; the slots
        [capacity] bool that are lost, because a chunk is missing, cut short or altered, or the chunks leave a gap; and
        one line for each such problem.

    Raises:
        ValueError: the ring has another capacity or shape.
    """
    shapes = zip(leaf_names(template), jax.tree.leaves(template), strict=True)
    leaves = {name: np.zeros(like.shape, like.dtype) for name, like in shapes}
    capacity = next(iter(leaves.values())).shape[0]
    first = max(0, written - capacity)
    lost, problems = np.zeros(capacity, bool), []
    for gap in _missing(first, written, chunks):
        lost[np.arange(gap.start, gap.stop) % capacity] = True
        problems.append(f"{folder}: no chunk holds the observations {gap.start} to {gap.stop - 1}")
    for chunk in sorted(chunks):
        live = np.arange(max(first, chunk.start), chunk.stop)
        try:
            arrays = _read(folder / chunk.name, chunk)
        except DamagedFileError as error:
            lost[live % capacity] = True
            problems.append(str(error))
            continue
        length = chunk.stop - chunk.start
        for name, leaf in leaves.items():
            if name not in arrays or arrays[name].shape != (length, *leaf.shape[1:]):
                raise ValueError(f"{folder / chunk.name}: {name} is not [{length}, {leaf.shape[1:]}]")
            leaf[live % capacity] = arrays[name][live - chunk.start]
    return rebuild(template, leaves, origin=str(folder)), lost, problems


def set_aside(folder: Path, chunks: list[Chunk]) -> None:
    """Rename the files of `chunks` that are damaged, so that they are written anew."""
    for chunk in chunks:
        try:
            _read(folder / chunk.name, chunk)
        except DamagedFileError:
            with suppress(FileNotFoundError):
                (folder / chunk.name).rename(folder / f"{chunk.name}.damaged")


def collect_garbage(folder: Path, referenced: set[str]) -> None:
    """Delete the chunks that no checkpoint refers to any more."""
    for path in folder.glob("*.npz"):
        if path.name not in referenced:
            path.unlink(missing_ok=True)


def _missing(first: int, written: int, chunks: list[Chunk]) -> Iterator[range]:
    """Yield the stretches of [first, written) outside `chunks`, each at most `CHUNK_LENGTH` long."""
    position = first
    for start, stop, _ in [*sorted(chunks), Chunk(written, written, "")]:
        for piece in range(position, start, CHUNK_LENGTH):
            yield range(piece, min(piece + CHUNK_LENGTH, start))
        position = max(position, stop)


def _write(folder: Path, leaves: dict[str, np.ndarray], numbers: range) -> Chunk:
    capacity = next(iter(leaves.values())).shape[0]
    slots = np.arange(numbers.start, numbers.stop) % capacity
    buffer = bytes_io.BytesIO()
    arrays: dict[str, Any] = {name: leaf[slots] for name, leaf in leaves.items()}
    np.savez_compressed(buffer, **arrays)
    chunk = Chunk(numbers.start, numbers.stop, hashlib.sha256(buffer.getbuffer()).hexdigest())
    io.write_bytes(folder / chunk.name, buffer.getvalue())
    return chunk


def _read(path: Path, chunk: Chunk) -> dict[str, np.ndarray]:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DamagedFileError(f"replay chunk {path} cannot be read ({error.strerror})") from None
    if hashlib.sha256(data).hexdigest() != chunk.sha256:
        raise DamagedFileError(f"replay chunk {path} is cut short or altered (checksum differs)")
    try:
        with np.load(bytes_io.BytesIO(data), allow_pickle=False) as arrays:
            return dict(arrays)
    except (ValueError, zipfile.BadZipFile) as error:
        raise DamagedFileError(f"replay chunk {path} is no npz file ({error})") from None
