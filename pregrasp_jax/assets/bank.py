"""The hull bank: build it from convex parts, join, select, save and load it."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from pregrasp_jax import io
from pregrasp_jax.assets.hulls import make_hulls
from pregrasp_jax.assets.measure import measure
from pregrasp_jax.types import COARSE_TOPOLOGY, FULL_TOPOLOGY, MAX_HULLS, HullBank, Hulls

DEFAULT_DENSITY = 300.0
"""kg/m^3 of the hulls' union: mostly full packages, 0.08 to 0.53 kg over the paper's seen set."""

DEFAULT_FRICTION = 0.25
"""Sliding friction between objects."""

FORMAT = "pregrasp_jax hull bank 2"
"""First entry of a bank file; the number changes with the meaning of the arrays."""

_PER_OBJECT = ("mass", "com", "inertia", "inertia_quat", "friction", "height", "min_width")


class ConvexObject(NamedTuple):
    """What a bank is made of: one object as convex parts, standing upright.

    Attributes:
        name: unique within a bank.
        parts: 1 to `MAX_HULLS` arrays [P, 3] m, z up; the lowest point is the base plane.
        mass: kg, or None for `density` times the volume of the union of the parts.
        density: kg/m^3, used where `mass` is None.
        friction: sliding friction against other objects.
    """

    name: str
    parts: Sequence[np.ndarray]
    mass: float | None = None
    density: float = DEFAULT_DENSITY
    friction: float = DEFAULT_FRICTION


def make_bank(objects: Sequence[ConvexObject]) -> HullBank:
    """Return the bank of several objects, in order.

    Raises:
        ValueError: a repeated name, or an object of more than `MAX_HULLS` parts or a flat part.
    """
    return concatenate([_make_single(item) for item in objects])


def concatenate(banks: Sequence[HullBank]) -> HullBank:
    """Join any number of banks; hull indices are shifted, object order is kept.

    Raises:
        ValueError: two objects of the same name.
    """
    banks = [_empty(), *banks]
    shifts = np.cumsum([0] + [len(bank.full.vertices) for bank in banks[:-1]])
    ids = [np.asarray(bank.object_hulls) for bank in banks]
    return _finish(
        full=_stack([bank.full for bank in banks]),
        coarse=_stack([bank.coarse for bank in banks]),
        object_hulls=np.concatenate([np.where(i >= 0, i + shift, -1) for i, shift in zip(ids, shifts, strict=True)]),
        names=tuple(name for bank in banks for name in bank.names),
        **{key: np.concatenate([getattr(bank, key) for bank in banks]) for key in _PER_OBJECT},
    )


def select(bank: HullBank, indices: Sequence[int] | np.ndarray) -> HullBank:
    """Return the bank of the objects at `indices`, in that order, with only their hulls.

    Raises:
        ValueError: an index outside the bank.
    """
    indices = np.asarray(indices, dtype=int).reshape(-1)
    bad = indices[(indices < 0) | (indices >= len(bank.names))]
    if bad.size:
        raise ValueError(f"object index {bad[0]} is outside the bank; allowed are 0 to {len(bank.names) - 1}")
    old = np.asarray(bank.object_hulls)[indices]
    object_hulls = np.where(old >= 0, np.cumsum(old.ravel() >= 0).reshape(old.shape) - 1, -1)
    hulls = old[old >= 0]
    return _finish(
        full=jax.tree.map(lambda rows: np.asarray(rows)[hulls], bank.full),
        coarse=jax.tree.map(lambda rows: np.asarray(rows)[hulls], bank.coarse),
        object_hulls=object_hulls,
        names=tuple(bank.names[i] for i in indices),
        **{key: np.asarray(getattr(bank, key))[indices] for key in _PER_OBJECT},
    )


def save_bank(path: Path, bank: HullBank, *, about: Mapping[str, Any] | None = None) -> None:
    """Write a bank as npz, whole or not at all.

    Args:
        path: the file.
        bank: the bank.
        about: JSON-able remarks that `load_about` returns; they are no part of the bank and of its hash.
    """
    arrays = {
        f"{level}_{key}": value for level in ("full", "coarse") for key, value in vars(getattr(bank, level)).items()
    }
    arrays |= {key: getattr(bank, key) for key in ("object_hulls", *_PER_OBJECT)}
    if about is not None:
        arrays["about"] = np.array(json.dumps(about))
    io.write_npz(
        path,
        format=np.array(FORMAT),
        content_hash=np.array(bank.content_hash),
        names=np.array(bank.names),
        **{key: np.asarray(value) for key, value in arrays.items()},
    )


def load_bank(path: Path) -> HullBank:
    """Read a bank written by `save_bank`.

    Raises:
        ValueError: the file is no hull bank, of another version, or its content does not match its hash.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
        arrays.pop("about", None)
        if str(arrays.pop("format")) != FORMAT:
            raise ValueError("format differs")
        recorded = str(arrays.pop("content_hash"))
        names = tuple(str(name) for name in arrays.pop("names"))
        full, coarse = (
            Hulls(**{key: arrays.pop(f"{level}_{key}") for key in ("vertices", "planes", "edges")})
            for level in ("full", "coarse")
        )
        object_hulls = arrays.pop("object_hulls")
        bank = _finish(full=full, coarse=coarse, object_hulls=object_hulls, names=names, **arrays)
        if bank.content_hash != recorded:
            raise ValueError("content hash differs")
    except FileNotFoundError:
        raise
    except Exception as error:
        raise ValueError(f"{path}: not a readable '{FORMAT}' file ({error}); delete it and build it again") from error
    return bank


def load_about(path: Path) -> dict[str, Any]:
    """Return the remarks that a bank was written with; none if there are none.

    Raises:
        ValueError: the file is damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            return json.loads(str(file["about"])) if "about" in file else {}
    except Exception as error:
        raise ValueError(f"{path}: not a readable '{FORMAT}' file ({error}); delete it and build it again") from error


def _empty() -> HullBank:
    """Return the bank of no object."""
    full, coarse = (
        Hulls(vertices=jnp.zeros((0, v, 3)), planes=jnp.zeros((0, f, 4)), edges=jnp.zeros((0, e, 2), jnp.int32))
        for v, f, e in (FULL_TOPOLOGY, COARSE_TOPOLOGY)
    )
    widths = {"com": (0, 3), "inertia": (0, 3), "inertia_quat": (0, 4)}
    rows = {key: np.zeros(widths.get(key, (0,))) for key in _PER_OBJECT}
    return _finish(full=full, coarse=coarse, object_hulls=np.zeros((0, MAX_HULLS)), names=(), **rows)


def _make_single(item: ConvexObject) -> HullBank:
    """Build the bank of one object in its own frame: base plane z = 0, centre of mass above the origin."""
    if not 1 <= len(item.parts) <= MAX_HULLS:
        raise ValueError(f"object '{item.name}' has {len(item.parts)} convex parts; allowed are 1 to {MAX_HULLS}")
    parts = [np.asarray(part, np.float64) for part in item.parts]
    lowest = min(part[:, 2].min() for part in parts)
    parts = [part - [0.0, 0.0, lowest] for part in parts]
    rough = make_hulls(parts, FULL_TOPOLOGY)
    centre = measure(np.asarray(rough.vertices), np.asarray(rough.planes)).com * [1.0, 1.0, 0.0]
    full = make_hulls([part - centre for part in parts], FULL_TOPOLOGY)
    # The coarse hulls are subsets of the full ones, so that they lie inside them.
    coarse = make_hulls(list(np.asarray(full.vertices, np.float64)), COARSE_TOPOLOGY)
    found = measure(np.asarray(full.vertices), np.asarray(full.planes))
    mass = found.volume * item.density if item.mass is None else item.mass
    moments, axes = np.linalg.eigh(found.inertia * (mass / found.volume))
    axes[:, 2] *= np.linalg.det(axes)  # a rotation, not a reflection
    return _finish(
        full=full,
        coarse=coarse,
        object_hulls=np.where(np.arange(MAX_HULLS) < len(parts), np.arange(MAX_HULLS), -1)[None],
        names=(item.name,),
        mass=np.array([mass]),
        com=np.array([[0.0, 0.0, found.com[2]]]),
        inertia=moments[None],
        inertia_quat=Rotation.from_matrix(axes).as_quat(scalar_first=True)[None],
        friction=np.array([item.friction]),
        height=np.array([np.asarray(full.vertices)[..., 2].max()]),
        min_width=np.array([found.min_width]),
    )


def _finish(
    *, full: Hulls, coarse: Hulls, object_hulls: np.ndarray, names: tuple[str, ...], **rows: np.ndarray
) -> HullBank:
    """Fix dtypes, check names and shapes, and hash the content."""
    if len(set(names)) != len(names):
        repeated = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"object name '{repeated}' is used twice; names must be unique")
    if set(rows) != set(_PER_OBJECT) or object_hulls.shape != (len(names), MAX_HULLS):
        raise ValueError(
            f"a bank of {len(names)} objects needs {MAX_HULLS} hull slots each and {', '.join(_PER_OBJECT)}"
        )
    bank = HullBank(
        full=jax.tree.map(jnp.asarray, full),
        coarse=jax.tree.map(jnp.asarray, coarse),
        object_hulls=jnp.asarray(object_hulls.astype(np.int32)),
        names=names,
        content_hash="",
        **{key: jnp.asarray(value.astype(np.float32)) for key, value in rows.items()},
    )
    digest = io.content_hash(FORMAT, list(names), *[np.asarray(leaf) for leaf in jax.tree.leaves(bank)])
    return bank.replace(content_hash=digest)


def _stack(levels: Sequence[Hulls]) -> Hulls:
    return jax.tree.map(lambda *rows: np.concatenate(rows), *levels)
