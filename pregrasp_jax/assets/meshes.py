"""Folders of meshes: load, check, decompose in parallel, cache, and refuse with a reason.

One bad mesh never stops the rest: it becomes a `Refusal`, one line that names what is wrong and what is allowed.
"""

import logging
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull

from pregrasp_jax import io
from pregrasp_jax.assets import bodies, decompose
from pregrasp_jax.assets.bank import FORMAT, ConvexObject, concatenate, load_about, load_bank, make_bank, save_bank
from pregrasp_jax.assets.fit import Fit, fit_parts
from pregrasp_jax.assets.folder import find_meshes
from pregrasp_jax.assets.formats import SUFFIXES, read_files
from pregrasp_jax.assets.mesh_file import load_mesh
from pregrasp_jax.assets.settings import (
    SETTINGS_FILE,
    UP_AXES,
    ObjectSettings,
    load_settings,
    refuse_beside_sets,
)
from pregrasp_jax.assets.workers import WorkerPool
from pregrasp_jax.messages import one_line
from pregrasp_jax.types import HullBank

LoadingProgress = Callable[[int, int, str], object]
"""Called as (done, total, file name) in the calling process."""

MIN_TIP_ANGLE = 0.05
"""rad by which the centre of mass must lie inside the base, seen from the centre of mass."""

_WORKERS = 2


class Refusal(NamedTuple):
    """A mesh that was not loaded.

    Attributes:
        name: file name inside the folder.
        reason: one line: what is wrong, what is allowed.
    """

    name: str
    reason: str


class Note(NamedTuple):
    """What a user should know of a mesh that was loaded.

    Attributes:
        name: file name inside the folder.
        text: one line.
    """

    name: str
    text: str


class LoadedDir(NamedTuple):
    """The meshes of one folder.

    Attributes:
        bank: of all good meshes, in the order of their names; empty if there are none.
        refusals: one for every other mesh.
        notes: remarks on the good ones.
        fits: by object name, how far its hulls are from its mesh.
        unused: lines about files that are not used: which, and why.
    """

    bank: HullBank
    refusals: Sequence[Refusal] = ()
    notes: Sequence[Note] = ()
    fits: Mapping[str, Fit] = MappingProxyType({})
    unused: Sequence[str] = ()


class _Job(NamedTuple):
    """One mesh to load: object name, name in the folder, file, settings."""

    name: str
    key: str
    path: Path
    settings: ObjectSettings


class _Prepared(NamedTuple):
    """What a worker makes of a mesh: the object, how well it fits, and why it may stand on the wrong side."""

    item: ConvexObject
    fit: Fit
    doubt: str


class _Loaded(NamedTuple):
    """What becomes of a good mesh: its bank, how well its hulls fit, and what is to be noted."""

    bank: HullBank
    fit: Fit
    notes: tuple[str, ...]


def load_object_dir(object_dir: Path, object_set: str, *, progress: LoadingProgress | None = None) -> LoadedDir:
    """Load every mesh of a folder as convex hulls, in the order of the file names.

    Args:
        object_dir: folder of meshes, or of folders with one each, in m, z up (or as `objects.yaml` says); with
            subfolders `seen` and `unseen` the one named by `object_set` is read, otherwise the folder itself is the
            seen set.
        object_set: `seen` or `unseen`.
        progress: called after every mesh.

    Returns:
        The bank of all good meshes, and what is to be said of the others and of them.

    Raises:
        ValueError: the folder or the set does not exist, holds no mesh, `objects.yaml` is wrong, or there is no place
            to store what is decomposed.
    """
    folder = mesh_folder(Path(object_dir), object_set)
    jobs, refusals, unused = _list_jobs(folder)
    loaded: dict[str, _Loaded] = {}
    done = len(refusals)
    total = done + len(jobs)
    for job, result in _results(jobs):
        if isinstance(result, str):
            refusals.append(Refusal(job.key, result))
        else:
            loaded[job.name] = result
        done += 1
        if progress is not None:
            progress(done, total, job.key)
    good = [job for job in jobs if job.name in loaded]
    return LoadedDir(
        bank=concatenate([loaded[job.name].bank for job in good]),
        refusals=sorted(refusals),
        notes=[Note(job.key, text) for job in good for text in loaded[job.name].notes],
        fits={job.name: loaded[job.name].fit for job in good},
        unused=_strays(Path(object_dir), folder) + unused,
    )


def mesh_folder(object_dir: Path, object_set: str) -> Path:
    """Return the folder that holds the meshes of a set.

    Raises:
        ValueError: it does not exist, or settings lie where they would not be read.
    """
    sets = ("seen", "unseen")
    if object_set not in sets:
        raise ValueError(f"object set '{object_set}' is unknown; allowed are {', '.join(sets)}")
    if not object_dir.is_dir():
        raise ValueError(f"{object_dir}: no such folder; allowed is a folder of {', '.join(SUFFIXES)} files")
    present = [name for name in sets if (object_dir / name).is_dir()]
    if object_set in present:
        refuse_beside_sets(object_dir, present)
        return object_dir / object_set
    if present or object_set != "seen":
        raise ValueError(f"{object_dir}: has no '{object_set}' set; allowed here are {', '.join(present or ['seen'])}")
    return object_dir


def make_object(name: str, path: Path, settings: ObjectSettings) -> _Prepared:
    """Read and decompose one mesh file.

    Raises:
        ValueError: one line about what is wrong with it.
    """
    mesh = load_mesh(path, settings)
    parts, fit = fit_parts(mesh)
    item = ConvexObject(name, parts, mass=settings.mass, density=settings.density, friction=settings.friction)
    return _Prepared(item, fit, mesh.metadata.get("doubt", ""))


def tip_angle(bank: HullBank, index: int) -> float:
    """Return by how much, in rad, an object may be tilted before it falls; negative if it does not stand at all."""
    ids = np.asarray(bank.object_hulls[index])
    points = np.asarray(bank.full.vertices, np.float64)[ids[ids >= 0]].reshape(-1, 3)
    base = points[points[:, 2] == 0.0, :2]
    if np.linalg.matrix_rank(base - base[0], tol=1e-3) < 2:
        return -np.pi / 2
    margin = -ConvexHull(base).equations[:, 2].max()
    return float(np.arctan2(margin, bank.com[index, 2]))


def _strays(object_dir: Path, folder: Path) -> list[str]:
    """Return a line about the meshes that lie beside the folder of their set."""
    if folder == object_dir:
        return []
    names = sorted(path.name for path in object_dir.iterdir() if path.suffix.lower() in SUFFIXES)
    return [f"{', '.join(names)}: beside the folder {folder.name}, whose meshes are read"] if names else []


def _list_jobs(folder: Path) -> tuple[list[_Job], list[Refusal], list[str]]:
    """Pair every mesh of a folder with its settings; refuse what is missing, unread or leads out of the folder."""
    defaults, listed = load_settings(folder)
    meshes, unread, unused = find_meshes(folder, listed)
    known = {name for mesh in meshes for name in (mesh.key, mesh.key.partition("/")[0])}
    refusals = [
        Refusal(name, f"listed in {SETTINGS_FILE} but {_why_absent(folder, name)}")
        for name in listed
        if name not in known
    ]
    formats = ", ".join(SUFFIXES)
    refusals += [Refusal(key, f"{Path(key).suffix} is not read; allowed are {formats}, convert it") for key in unread]
    if not meshes and not unread:
        raise ValueError(f"{folder}: holds no mesh; allowed are {formats} files")
    jobs = []
    counts = Counter(mesh.key for mesh in meshes)
    for name, key, path in meshes:
        if not path.is_file():  # first, since a link in a loop cannot be resolved
            refusals.append(Refusal(key, "missing or not a file; allowed are files inside the folder"))
        elif not path.resolve().is_relative_to(folder.resolve()):
            refusals.append(Refusal(key, "link that leads out of the folder; allowed are files inside of it"))
        elif counts[key] > 1:
            refusals.append(Refusal(key, "two files have this name, in two Unicode forms; allowed is one of them"))
        else:
            settings = listed.get(key, listed.get(key.partition("/")[0], defaults))
            jobs.append(_Job(name, key, path, settings))
    return jobs, refusals, unused


def _why_absent(folder: Path, name: str) -> str:
    if not (folder / name).resolve().is_relative_to(folder.resolve()):
        return "leads out of the folder; allowed are names of files inside of it"
    if Path(name).suffix.lower() not in SUFFIXES:
        return f"not a mesh; allowed are {', '.join(SUFFIXES)}"
    if (folder / name).is_file():
        return "of a folder of which another mesh is listed; allowed is one mesh a folder"
    return f"missing; allowed are names of files in {folder.name}"


def _results(jobs: Sequence[_Job]):
    """Yield every job with what became of it, or the reason for its refusal; cached ones first.

    Raises:
        ValueError: something must be decomposed, and there is no place to store it.
    """
    pending: list[tuple[_Job, Path]] = []
    for job in jobs:
        try:
            cached = io.cache_dir() / "hulls" / f"{_cache_key(job)}.npz"
        except OSError as error:
            yield job, f"cannot be read ({error.strerror}); allowed are readable files"
            continue
        except ValueError as error:
            yield job, one_line(error)
            continue
        if loaded := _load_cached(job, cached):
            yield job, loaded
        else:
            pending.append((job, cached))
    if pending:
        io.refuse_unwritable_cache(pending[0][1])
    for index, made in _decompose_all([job for job, _ in pending]):
        job, cached = pending[index]
        result = made if isinstance(made, str) else _finish(made)
        if isinstance(result, _Loaded):
            save_bank(cached, result.bank, about={"fit": result.fit.as_numbers(), "notes": result.notes})
        yield job, result


def _load_cached(job: _Job, cached: Path) -> _Loaded | None:
    """Return what was made of one mesh, None if it is absent or damaged; the latter is a warning."""
    if not cached.is_file():
        return None
    try:
        about = load_about(cached)
        return _Loaded(load_bank(cached), Fit.from_numbers(about["fit"]), tuple(about["notes"]))
    except (OSError, ValueError, KeyError):
        warnings.warn(f"{cached} is damaged; {job.key} is decomposed anew", stacklevel=2)
        return None


def _cache_key(job: _Job) -> str:
    files = read_files(job.path)
    return io.content_hash(*files, job.path.suffix, job.name, asdict(job.settings), decompose.VERSION, FORMAT)


def _decompose_all(jobs: Sequence[_Job]):
    """Yield (index, object or reason) from worker processes, in order of completion.

    CoACD is native code: a mesh that makes it crash takes its process down, so after a crash the unfinished
    meshes run one process each and only the guilty one is refused.
    """
    unfinished = dict(enumerate(jobs))
    for width in (_WORKERS, 1):
        batches = [list(unfinished)] if width > 1 else [[index] for index in unfinished]
        for batch in filter(None, batches):
            with WorkerPool(width) as pool:
                futures = {pool.submit(_try_job, jobs[index]): index for index in batch}
                for future in as_completed(futures):
                    if not isinstance(future.exception(), BrokenProcessPool):
                        del unfinished[futures[future]]
                        yield futures[future], future.result()
    for index in unfinished:
        yield (
            index,
            "the worker process died; allowed are meshes that CoACD can decompose",
        )


def _try_job(job: _Job) -> _Prepared | str:
    """Run in a worker: the object, or why it is refused."""
    logging.disable(logging.WARNING)  # trimesh comments on every oddity that the checks below report
    try:
        return make_object(job.name, job.path, job.settings)
    except Exception as error:
        return one_line(error)


def _finish(made: _Prepared) -> _Loaded | str:
    """Build the bank of one object and check that it stands; else the reason."""
    try:
        bank = make_bank([made.item])
    except ValueError as error:
        return one_line(error)
    angle = tip_angle(bank, 0)
    if angle < MIN_TIP_ANGLE:
        return (
            f"does not stand: tips over at {angle:.2f} rad, must be >= {MIN_TIP_ANGLE}; "
            f"another up axis ({', '.join(UP_AXES)}) can be set in {SETTINGS_FILE}"
        )
    return _Loaded(bank, made.fit, tuple(filter(None, (made.doubt, made.fit.remark(), bodies.remark(made.item.parts)))))
