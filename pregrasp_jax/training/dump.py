"""Dumps: files from which a push that made the physics diverge can be repeated.

    RUN_DIR/dumps/step-003200-scene-4.npz
        about           JSON: format, engine, hashes of objects and scenes, versions, configuration of the run
        state/...       the scene before the push, as the engine holds it (`state/physics/...`) and as anybody sees it
        action          flat index of the push; scene, branch and env_steps say which one it was
        seen/...        what the engine reported afterwards
        qpos, qvel      of the state, float32, for other engines

Nothing is pickled, and one file takes some kilobytes.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pregrasp_jax import io
from pregrasp_jax.checkpoint import trees
from pregrasp_jax.config import Config
from pregrasp_jax.machine import versions
from pregrasp_jax.settings import to_dict
from pregrasp_jax.task.env import Env
from pregrasp_jax.training.mishap import Mishap, no_mishap
from pregrasp_jax.types import MAX_OBJECTS, SceneParams

FORMAT = "pregrasp_jax dump 2"

MAX_DUMPS = 20
"""Files per run: a setting with which every push diverges shall not fill the disk."""

COORDINATES = ("qpos", "qvel")
"""Arrays beside those of the mishap."""

_WANTED = "wanted is a file of RUN_DIR/dumps that a training wrote"

DumpFn = Callable[[Path, Mishap], Path | None]
"""``(folder, mishap) -> path`` of the file that was written; None if the folder is full."""


@dataclass(frozen=True)
class Dump:
    """A file that was read.

    Attributes:
        path: of the file.
        engine: that ran the push.
        hull_bank_hash: of the objects.
        scene_bank_hash: of the scenes that resets drew from.
        versions: of the packages that were used.
        config: of the run.
        arrays: everything else, by name.
    """

    path: Path
    engine: str
    hull_bank_hash: str
    scene_bank_hash: str
    versions: dict[str, str]
    config: Config
    arrays: dict[str, np.ndarray]

    def mishap(self, env: Env) -> Mishap:
        """Return the push for an environment with the same objects; another engine takes up qpos and qvel.

        Args:
            env: its engine may be another one than that of the training.

        Raises:
            ValueError: arrays are missing or do not fit.
        """
        template = jax.eval_shape(lambda: no_mishap(jax.vmap(env.start)(_no_scenes())))
        if env.engine.name == self.engine:
            return self._rebuild(template, lambda name: name not in COORDINATES)
        foreign = template.replace(state=template.state.replace(physics=None))
        mishap = self._rebuild(foreign, lambda name: name not in COORDINATES and not name.startswith("state/physics/"))
        shapes = jax.eval_shape(lambda: env.engine.coordinates(env.engine.init()))
        found = self._rebuild(dict(zip(COORDINATES, shapes, strict=True)), lambda name: name in COORDINATES)
        physics = env.engine.place(mishap.state.scene.object_ids, *(found[name] for name in COORDINATES))
        return mishap.replace(state=mishap.state.replace(physics=physics))

    def _rebuild(self, template: Any, wanted: Callable[[str], bool]) -> Any:
        arrays = {name: array for name, array in self.arrays.items() if wanted(name)}
        try:
            return trees.rebuild(template, arrays, origin=str(self.path))
        except ValueError as error:
            raise ValueError(f"{error}; {_WANTED}") from None


def make_dump(env: Env, config: Config) -> DumpFn:
    """Return the function that writes a mishap of a run, unless its folder holds `MAX_DUMPS` already.

    Raises (the function that is returned):
        OSError: the disk is full; nothing of the file is left.
    """
    about = {
        "format": FORMAT,
        "engine": env.engine.name,
        "hull_bank_hash": env.bank.content_hash,
        "scene_bank_hash": env.scenes.content_hash,
        "versions": versions(),
        "config": to_dict(config),
    }

    def dump(folder: Path, mishap: Mishap) -> Path | None:
        path = folder / f"step-{int(mishap.env_steps):06d}-scene-{int(mishap.scene)}.npz"
        if not path.exists() and len(list(folder.glob("step-*.npz"))) >= MAX_DUMPS:
            return None
        coordinates = (np.asarray(x) for x in env.engine.coordinates(mishap.state.physics))
        arrays = trees.named_leaves(mishap)
        io.write_npz(
            path, about=np.array(json.dumps(about)), **dict(zip(COORDINATES, coordinates, strict=True)), **arrays
        )
        return path

    return dump


def load_dump(path: Path) -> Dump:
    """Read a dump; whether its arrays fit shows in `Dump.mishap`.

    Raises:
        ValueError: the file is missing, damaged, or something else; one line says so.
    """
    if not path.is_file():
        raise ValueError(f"{path} does not exist or is no file; {_WANTED}")
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except Exception:  # zipfile, zlib, struct and numpy have one each for every kind of damage
        raise ValueError(f"{path} is damaged or no npz; {_WANTED}") from None
    try:
        about = json.loads(str(arrays.pop("about")))
        if about.pop("format") != FORMAT:
            raise ValueError
        config = about.pop("config")
    except (ValueError, KeyError, TypeError, AttributeError):
        raise ValueError(f"{path} is no dump of this version; {_WANTED}") from None
    try:
        return Dump(path=path, config=Config.from_dict(config).validate(), arrays=arrays, **about)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}; {_WANTED}") from None


def _no_scenes() -> SceneParams:
    """Return a batch of one empty scene, for its shapes."""
    return SceneParams(
        jnp.full((1, MAX_OBJECTS), -1, jnp.int32), jnp.zeros((1, MAX_OBJECTS, 7)), jnp.zeros(1, jnp.int32)
    )
