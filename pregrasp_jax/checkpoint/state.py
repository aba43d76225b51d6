"""Checkpoints of the whole state.

    checkpoints/
        000012800/state.safetensors     every leaf of the training state but the observations
                  manifest.json         written last: without it the checkpoint does not exist
        replay/000000000000-....npz     observations, append-only (see `chunks`)

Every file carries a checksum. A damaged checkpoint is set aside and the one before it is used. Checkpoints share the
observations; only if damage to these leaves none whole is the newest used without what is lost.
"""

import dataclasses
import hashlib
import json
import os
import shutil
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from pregrasp_jax import io
from pregrasp_jax.checkpoint import chunks, trees
from pregrasp_jax.checkpoint.chunks import Chunk, Ring
from pregrasp_jax.checkpoint.trees import DamagedFileError

FORMAT = 1
"""Version of the layout above."""

KEEP = 3
"""Checkpoints kept: two to fall back to."""

_FIRST_POLICY = "learning/learner/target_params/"
"""What `save` was told in runs whose manifests do not say so."""

_STATE, _MANIFEST, _REPLAY = "state.safetensors", "manifest.json", "replay"


@dataclasses.dataclass(frozen=True)
class Restored:
    """A checkpoint that was read back.

    Attributes:
        step: env steps at which it was taken.
        tree: the state.
        ring: the observations.
        extra: what `save` was given.
        lost: [capacity] bool, slots of the ring whose observations no intact file holds; they are 0.
        problems: one line for everything that was damaged and has been set aside.
    """

    step: int
    tree: Any
    ring: Any
    extra: dict[str, Any]
    lost: np.ndarray
    problems: tuple[str, ...]


def save(folder: Path, step: int, tree: Any, ring: Ring, extra: dict[str, Any], *, policy: str) -> Path:
    """Write a checkpoint, then delete what is older than the last `KEEP`.

    A crash at any instant leaves the previous checkpoints intact.

    Args:
        folder: the run's `checkpoints`.
        step: env steps so far, the name of the checkpoint.
        tree: pytree of arrays, without the contents of the ring.
        ring: observations; only those since the last checkpoint are written.
        extra: JSON-able, for what lives on the host.
        policy: how the names of the leaves begin that a policy needs, its parameters.

    Returns:
        The folder of the checkpoint.

    Raises:
        OSError: the disk is full; nothing of this checkpoint is left.
    """
    target = folder / f"{step:09d}"
    # Of a chunk that was lost and written anew, the newest checkpoint knows the right checksum.
    known = {chunk.name: chunk for path in reversed([*_newest_first(folder)]) for chunk in _listed_chunks(path)}
    try:
        current = chunks.append(folder / _REPLAY, ring, sorted(known.values()))
        state = trees.encode(trees.named_leaves(tree))
        # A checkpoint of the same step stays valid meanwhile: the state of a step is always the same.
        io.write_bytes(target / _STATE, state)
        manifest = {
            "format": FORMAT,
            "step": step,
            "state_sha256": hashlib.sha256(state).hexdigest(),
            "state_checksum": trees.checksum(tree),
            "policy": policy,
            "observations": ring.written,
            "chunks": [list(chunk) for chunk in current],
            "extra": extra,
        }
        io.write_json(target / _MANIFEST, {"checksum": io.content_hash(manifest), **manifest})
    finally:  # also after a failure, so that a full disk does not fill further with halves
        _prune(folder)
    return target


def exists(folder: Path) -> bool:
    """Return whether a checkpoint was ever completed in a folder."""
    return any(_newest_first(folder))


def restore(folder: Path, template: Any, ring_template: Any) -> Restored:
    """Read the newest intact checkpoint; damaged ones are renamed to ``*.damaged`` and reported.

    If none is intact, but the state of one is, that is used without the observations that are lost.

    Args:
        folder: the run's `checkpoints`.
        template: tree like the one given to `save`; arrays or `jax.ShapeDtypeStruct`.
        ring_template: likewise for the contents of the ring.

    Raises:
        ValueError: there is no checkpoint, none is intact, or it belongs to another configuration.
    """
    damaged: dict[Path, str] = {}
    partial: list[Path] = []
    for path in _newest_first(folder):
        try:
            restored = _read(path, template, ring_template)
        except DamagedFileError as error:
            damaged[path] = str(error)
            continue
        if restored.problems:
            partial.append(path)
            damaged[path] = restored.problems[0]
            del restored  # gigabytes, while the next one is read
            continue
        for broken in damaged:
            _set_aside(broken)
        return dataclasses.replace(restored, problems=tuple(damaged.values()))
    if partial:
        return _settle_for(partial[0], damaged, template, ring_template)
    if damaged:
        raise ValueError(
            f"{folder}: none of {len(damaged)} checkpoints is intact; newest: {next(iter(damaged.values()))}; allowed "
            "is a run with one that is; --init-from starts a new run from its best policy"
        )
    raise ValueError(f"{folder} holds no checkpoint")


def _read(path: Path, template: Any, ring_template: Any) -> Restored:
    """Read one checkpoint; what is wrong with its observations is listed, not raised."""
    try:
        manifest = _read_manifest(path)
        tree = trees.rebuild(template, _read_state(path, manifest), origin=str(path / _STATE))
        listed = [Chunk(*row) for row in manifest["chunks"]]
        ring, lost, problems = chunks.restore(path.parent / _REPLAY, ring_template, manifest["observations"], listed)
    except DamagedFileError:
        raise
    except ValueError as error:
        raise ValueError(
            f"{error}; allowed is a checkpoint of the same configuration and version; --init-from starts a new run "
            "from its parameters"
        ) from None
    return Restored(manifest["step"], tree, ring, manifest["extra"], lost, tuple(problems))


def _settle_for(path: Path, damaged: dict[Path, str], template: Any, ring_template: Any) -> Restored:
    """Return a checkpoint without the observations that are lost, and set aside the newer ones and these files."""
    restored = _read(path, template, ring_template)
    newer = [broken for broken in damaged if int(broken.name) > restored.step]
    for broken in newer:
        _set_aside(broken)
    chunks.set_aside(path.parent / _REPLAY, _listed_chunks(path))
    return dataclasses.replace(restored, problems=(*(damaged[broken] for broken in newer), *restored.problems))


def read_newest_policy(folder: Path) -> tuple[dict[str, np.ndarray], Path]:
    """Return the parameters of the newest intact checkpoint by name, and its folder; changes nothing on disk.

    Warns of newer ones that are damaged.

    Raises:
        ValueError: there is none.
    """
    damaged: list[str] = []
    for path in _newest_first(folder):
        try:
            manifest = _read_manifest(path)
            arrays, prefix = _read_state(path, manifest), manifest.get("policy", _FIRST_POLICY)
            named = {name.removeprefix(prefix): leaf for name, leaf in arrays.items() if name.startswith(prefix)}
        except DamagedFileError as error:
            damaged.append(str(error))
            continue
        for problem in damaged:
            warnings.warn(f"{problem}; the policy of {path.name} is used", stacklevel=3)
        return named, path
    raise ValueError(f"{folder} holds no intact checkpoint")


def read_ring(folder: Path, ring_template: Any) -> tuple[Any, int]:
    """Return the observations of the newest intact checkpoint and how many were written; changes nothing on disk.

    Raises:
        ValueError: there is none.
    """
    for path in _newest_first(folder):
        try:
            manifest = _read_manifest(path)
        except DamagedFileError:
            continue
        listed, written = [Chunk(*row) for row in manifest["chunks"]], manifest["observations"]
        contents, _, problems = chunks.restore(folder / _REPLAY, ring_template, written, listed)
        if not problems:
            return contents, written
    raise ValueError(f"{folder} holds no intact checkpoint")


def _newest_first(folder: Path) -> Iterator[Path]:
    """Yield the folders of committed checkpoints."""
    named = [path for path in folder.glob("*") if path.name.isdigit() and (path / _MANIFEST).is_file()]
    yield from sorted(named, key=lambda path: int(path.name), reverse=True)


def _read_manifest(path: Path) -> dict[str, Any]:
    origin = path / _MANIFEST
    try:
        manifest = json.loads(origin.read_bytes())
        checksum, version = manifest.pop("checksum"), manifest["format"]
    except (OSError, UnicodeDecodeError, json.JSONDecodeError, KeyError, TypeError, AttributeError):
        raise DamagedFileError(f"{origin} is damaged") from None
    if io.content_hash(manifest) != checksum:
        raise DamagedFileError(f"{origin} is altered (checksum differs)")
    if version != FORMAT:
        raise ValueError(f"{origin} has format {version}; this version reads {FORMAT}")
    return manifest


def _read_state(path: Path, manifest: dict[str, Any]) -> dict[str, np.ndarray]:
    try:
        data = (path / _STATE).read_bytes()
    except OSError as error:
        raise DamagedFileError(f"{path / _STATE} cannot be read ({error.strerror})") from None
    if hashlib.sha256(data).hexdigest() != manifest["state_sha256"]:
        raise DamagedFileError(f"{path / _STATE} is cut short or altered (checksum differs)")
    return trees.decode(data, origin=str(path / _STATE))


def _listed_chunks(path: Path) -> list[Chunk]:
    """Return the chunks that a checkpoint refers to; none if its manifest is damaged."""
    try:
        return [Chunk(*row) for row in _read_manifest(path)["chunks"]]
    except DamagedFileError:
        return []


def _prune(folder: Path) -> None:
    """Delete old and unfinished checkpoints, and the chunks that only they refer to."""
    kept = list(_newest_first(folder))[:KEEP]
    for path in folder.glob("*"):
        if path.name.isdigit() and path not in kept:
            shutil.rmtree(path, ignore_errors=True)
    chunks.collect_garbage(folder / _REPLAY, {chunk.name for path in kept for chunk in _listed_chunks(path)})


def _set_aside(path: Path) -> None:
    aside = path.with_name(f"{path.name}.damaged")
    shutil.rmtree(aside, ignore_errors=True)
    os.replace(path, aside)
