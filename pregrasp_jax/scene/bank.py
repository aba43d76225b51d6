"""The scene bank: packed scenes on disk, one file per object set, split and seed.

Try t of a split is drawn from its own seed, so that a bank does not depend on how many scenes are packed at
once, and train, validation and test never share one.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np

from pregrasp_jax import io
from pregrasp_jax.config import SceneConfig
from pregrasp_jax.messages import one_line
from pregrasp_jax.scene import packing
from pregrasp_jax.types import MAX_OBJECTS, HullBank

Split = Literal["train", "validation", "test"]
SPLITS: tuple[Split, ...] = ("train", "validation", "test")
PackingProgress = Callable[[int, int], None]
"""Called with scenes done and scenes wanted."""

VERSION = 1
"""Of how scenes are drawn and packed: raise it when the same settings would give other scenes."""

_CHUNK = 16
_FIELDS = ("object_ids", "poses", "yaw", "target", "seeds")
_MIN_TRIES, _MIN_ACCEPTANCE = 4 * _CHUNK, 0.1
"""A set of which so few tries succeed after so many is refused."""


@dataclass(frozen=True)
class SceneBank:
    """S packed scenes of one split.

    Attributes:
        object_ids: [S, MAX_OBJECTS] int32 index into the hull bank, -1 for an empty slot.
        poses: [S, MAX_OBJECTS, 7] float32, before any yaw.
        yaw: [S] float32 rad, the rotation about the centre that evaluation uses.
        target: [S] int32 slot of the target that evaluation uses.
        seeds: [S] int64, the try that gave the scene.
        split: `train`, `validation` or `test`.
        tries: how many tries gave the S scenes.
        content_hash: hash of everything that shaped the bank.
    """

    object_ids: np.ndarray
    poses: np.ndarray
    yaw: np.ndarray
    target: np.ndarray
    seeds: np.ndarray
    split: Split
    tries: int
    content_hash: str

    def __len__(self) -> int:
        """Return the number of scenes."""
        return len(self.object_ids)


def bank_hash(bank: HullBank, eligible: np.ndarray, config: SceneConfig, split: Split) -> str:
    """Return the hash of what shapes a scene bank: objects, who may be a target, settings, MuJoCo, and `VERSION`."""
    sizes = (config.min_objects, config.max_objects, num_scenes(config, split), config.bank_seed, split)
    return io.content_hash(bank.content_hash, eligible, list(sizes), mujoco.__version__, VERSION)


def num_scenes(config: SceneConfig, split: Split) -> int:
    """Return how many scenes the split holds."""
    return {"train": config.train_scenes, "validation": config.validation_scenes, "test": config.test_scenes}[split]


def load_or_build(
    bank: HullBank,
    eligible: np.ndarray,
    config: SceneConfig,
    split: Split,
    *,
    threads: int = 0,
    progress: PackingProgress | None = None,
) -> SceneBank:
    """Return the split's scenes from the cache, or pack them and store them there; a damaged file is a warning.

    Args:
        bank: the objects.
        eligible: [N] bool, which of them may be targets (see `Robot.eligibility`).
        config: how many scenes, how crowded.
        split: `train`, `validation` or `test`.
        threads: 0 takes every core.
        progress: told about scenes packed so far.

    Raises:
        ValueError: the object set cannot be packed (too few objects accepted or no eligible target), or there is
            no place to store the scenes.
    """
    digest = bank_hash(bank, eligible, config, split)
    path = io.cache_dir() / "scenes" / f"{split}-{digest}.npz"
    if path.is_file():
        try:
            return load(path, digest)
        except ValueError as error:
            warnings.warn(f"{one_line(error)}; its scenes are packed anew", stacklevel=2)
    io.refuse_unwritable_cache(path)
    scenes = build(bank, eligible, config, split, threads=threads, progress=progress)
    save(path, scenes)
    return scenes


def save(path: Path, scenes: SceneBank) -> None:
    """Write a scene bank as npz, whole or not at all."""
    arrays = {name: getattr(scenes, name) for name in _FIELDS}
    about = np.array([scenes.split, str(scenes.tries), scenes.content_hash])
    io.write_npz(path, about=about, **arrays)


def load(path: Path, expected_hash: str | None = None) -> SceneBank:
    """Read a scene bank.

    Raises:
        ValueError: the file is missing, corrupt, not a scene bank, or made for other objects or settings.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            split, tries, digest = (str(x) for x in file["about"])
            arrays = {name: file[name] for name in _FIELDS}
    except Exception as error:
        raise ValueError(f"{path}: not a readable scene bank ({type(error).__name__}: {error})") from error
    if split not in SPLITS or arrays["poses"].shape[1:] != (MAX_OBJECTS, 7):
        raise ValueError(f"{path}: not a scene bank of {MAX_OBJECTS} slots")
    if expected_hash is not None and digest != expected_hash:
        raise ValueError(f"{path}: made for other objects or settings (hash {digest}, wanted {expected_hash})")
    return SceneBank(**arrays, split=split, tries=int(tries), content_hash=digest)


def build(
    bank: HullBank,
    eligible: np.ndarray,
    config: SceneConfig,
    split: Split,
    *,
    threads: int = 0,
    progress: PackingProgress | None = None,
) -> SceneBank:
    """Pack scenes until the split is full; see `load_or_build`."""
    wanted = num_scenes(config, split)
    if not eligible.any():
        raise ValueError("hull bank: no object is an eligible target; at least one must be")
    packer = packing.Packer(bank, _CHUNK, threads=threads)
    rows: list[tuple[np.ndarray, np.ndarray, float, int, int]] = []
    tries = 0
    while len(rows) < wanted:
        if tries >= _MIN_TRIES and len(rows) < _MIN_ACCEPTANCE * tries:
            raise ValueError(
                f"scene bank: only {len(rows)} of {tries} tries were packed; at least "
                f"{_MIN_ACCEPTANCE:.0%} is needed. Use objects that stand by themselves, or fewer of them"
            )
        seeds = np.arange(tries, tries + _CHUNK)
        rngs = [np.random.default_rng([config.bank_seed, SPLITS.index(split), int(seed)]) for seed in seeds]
        draws = [_draw(eligible, config, rng) for rng in rngs]
        object_ids = np.stack([ids for ids, _, _ in draws])
        poses, accepted = packer.pack(object_ids, rngs)
        for i in np.flatnonzero(accepted):
            rows.append((object_ids[i], poses[i], draws[i][1], draws[i][2], int(seeds[i])))
        tries += _CHUNK
        if progress:
            progress(min(len(rows), wanted), wanted)
    rows = rows[:wanted]
    object_ids, poses, yaw, target, seeds = (np.stack(column) for column in zip(*rows, strict=True))
    return SceneBank(
        object_ids=object_ids.astype(np.int32),
        poses=poses.astype(np.float32),
        yaw=yaw.astype(np.float32),
        target=target.astype(np.int32),
        seeds=seeds,
        split=split,
        tries=int(seeds[-1]) + 1,
        content_hash=bank_hash(bank, eligible, config, split),
    )


def _draw(eligible: np.ndarray, config: SceneConfig, rng: np.random.Generator) -> tuple[np.ndarray, float, int]:
    """Draw objects (at least one of them eligible), a yaw, and an eligible target slot."""
    count = int(rng.integers(config.min_objects, config.max_objects + 1))
    while True:
        chosen = rng.choice(len(eligible), count, replace=count > len(eligible))
        if eligible[chosen].any():
            break
    object_ids = np.full(MAX_OBJECTS, -1)
    object_ids[:count] = chosen
    return object_ids, rng.uniform(-np.pi, np.pi), int(rng.choice(np.flatnonzero(eligible[chosen])))
