"""Objects made for training, so that a policy meets more shapes than a set has: drawn, checked, built, cached.

Object i of a stream depends on the known objects, the seed and i alone, so a larger number only adds to a smaller one.
"""

import warnings
from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from pregrasp_jax import io
from pregrasp_jax.assets.bank import ConvexObject, concatenate, load_bank, make_bank, save_bank
from pregrasp_jax.assets.hulls import volume
from pregrasp_jax.assets.measure import min_width
from pregrasp_jax.assets.shapes import FAMILIES, HEIGHT, Parts
from pregrasp_jax.messages import one_line
from pregrasp_jax.types import MAX_HULLS, HullBank

MakingProgress = Callable[[int, int], None]
"""Called with objects made and objects wanted."""

VERSION = 1
"""Of how objects are drawn: raise it when the same seed would give others."""

DENSITY = 200.0, 450.0
"""kg/m^3; real meshes get 300."""

MASS = 0.05, 0.8
"""kg, by the volumes of the parts."""

MAX_SIDE = 0.145
"""m, widest extent across, handles included; the catalogue's pitcher has 0.14."""

MIN_BASE, MAX_SLENDERNESS = 0.034, 4.2
"""m, narrowest width of the base; height per such width. The catalogue has 4.1."""


_TRIES = 2000
"""Draws of one object; of the built-in ones a few are enough."""


def variant_bank(
    known: HullBank, number: int, *, seed: Sequence[int], progress: MakingProgress | None = None
) -> HullBank:
    """Return `number` objects made beside the `known` ones, from the cache if they were made before.

    Args:
        known: objects that some are scaled, cut and joined from.
        number: how many; each takes a quarter of a second.
        seed: which ones; streams of different seeds share none.
        progress: told about objects made so far, if any must be made.
    """
    digest = io.content_hash(known.content_hash, number, list(seed), VERSION)
    path = io.cache_dir() / "hulls" / f"variants-{digest}.npz"
    if path.is_file():
        try:
            return load_bank(path)
        except ValueError as error:
            warnings.warn(f"{one_line(error)}; its objects are made anew", stacklevel=2)
    io.refuse_unwritable_cache(path)
    parts, made = known_parts(known), []
    for index in range(number):
        made.append(make_bank([draw_variant(parts, index, seed=seed)]))
        if progress:
            progress(index + 1, number)
    bank = concatenate(made)
    save_bank(path, bank)
    return bank


def known_parts(bank: HullBank) -> list[Parts]:
    """Return the hulls [V, 3] m of every object of a bank."""
    vertices = np.asarray(bank.full.vertices, np.float64)
    return [[vertices[i] for i in ids if i >= 0] for ids in np.asarray(bank.object_hulls)]


def draw_variant(known: Sequence[Parts], index: int, *, seed: Sequence[int]) -> ConvexObject:
    """Return object `index` of a stream: the first draw of its family that could stand on a table.

    Args:
        known: parts of the objects that some are made from.
        index: which.
        seed: of the stream.

    Raises:
        ValueError: nothing of the family can be made of the known objects.
    """
    rng = np.random.default_rng([*seed, index])
    shares = np.array([share for _, share in FAMILIES.values()])
    name = list(FAMILIES)[rng.choice(len(shares), p=shares / shares.sum())]
    draw = FAMILIES[name][0]
    density = rng.uniform(*DENSITY)
    why = ""
    for _ in range(_TRIES):
        parts = draw(rng, known)
        if not (why := why_not(parts, density)):
            return ConvexObject(f"made_{index:04d}_{name}", parts, density=density)
    raise ValueError(
        f"no object of the kind {name!r} can be made of these objects (the last of {_TRIES} tries has {why}); allowed "
        "is assets.variants = 0, or objects of which some would stand if they were scaled"
    )


def why_not(parts: Parts, density: float) -> str:
    """Return why nothing like this could stand on a table, one clause; empty if it could."""
    if not 1 <= len(parts) <= MAX_HULLS:
        return f"{len(parts)} parts, allowed are 1 to {MAX_HULLS}"
    points = np.concatenate(parts)
    height, side = np.ptp(points[:, 2]), np.ptp(points[:, :2], axis=0).max()
    if not HEIGHT[0] <= height <= HEIGHT[1] or side > MAX_SIDE:
        return f"{side:.3f} m wide and {height:.3f} m high"
    base = _base_width(points)
    if base < max(MIN_BASE, height / MAX_SLENDERNESS):
        return f"a base of {base:.3f} m for a height of {height:.3f} m"
    mass = density * sum(volume(part) for part in parts)
    if not MASS[0] <= mass <= MASS[1]:
        return f"a mass of {mass:.3f} kg"
    return ""


def _base_width(points: np.ndarray) -> float:
    """Return the narrowest width, m, of what touches the table; 0 if that is no area."""
    base = points[points[:, 2] < points[:, 2].min() + 1e-6, :2]
    try:
        return min_width(base[ConvexHull(base).vertices]) if len(base) > 2 else 0.0
    except QhullError:
        return 0.0
