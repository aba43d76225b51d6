"""Household shapes drawn at random, as convex parts: what a training may see beside the objects of its set.

Every family is a function of a generator and of the parts of known objects, and returns 1 or more parts [P, 3] m that
stand on z = 0. Sizes are drawn from what a table holds and a hand meets; `variants` sorts out what could not stand.
"""

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from pregrasp_jax.assets.hulls import MIN_THICKNESS

Parts = list[np.ndarray]
Family = Callable[[np.random.Generator, Sequence[Parts]], Parts]

SHORT_SIDE = 0.038, 0.1
"""m, narrower side of a body seen from above: from a spray can to what hardly fits between the fingers."""

ASPECT = 1.0, 1.45
"""Longer side of an oblong body per narrower side."""

HEIGHT = 0.11, 0.27
"""m; pushes are made 0.1 m above the table."""

SCALE_ACROSS, SCALE_UP = (0.75, 1.25), (0.85, 1.2)
"""Factors on the two horizontal axes of a known object, and on its height."""

SECTIONS = 24
"""Points around a cross-section; a hull keeps 32 in all."""


def superellipse(width: float, depth: float, exponent: float, count: int) -> np.ndarray:
    """Return the outline [count, 2] of a superellipse: exponent 2 is an ellipse, 8 and more a rounded box."""
    angle = np.arange(count) * (2 * np.pi / count)
    x, y = (np.sign(f) * np.abs(f) ** (2 / exponent) for f in (np.cos(angle), np.sin(angle)))
    return np.column_stack([width / 2 * x, depth / 2 * y])


def solid(profile: Sequence[tuple[float, float]], outline: np.ndarray) -> Parts:
    """Return the convex parts of an outline [P, 2] m that is scaled by a factor on its way up.

    Args:
        profile: (factor, z m) from the base to the top; between two of them the factor is linear.
        outline: [P, 2] m, convex.
    """
    rings = [np.column_stack([factor * outline, np.full(len(outline), z)]) for factor, z in profile]
    slopes = [(after[0] - before[0]) / (after[1] - before[1]) for before, after in pairwise(profile)]
    bends = [i for i, (below, above) in enumerate(pairwise(slopes), start=1) if above > below + 1e-9]
    return [np.concatenate(rings[low : high + 1]) for low, high in pairwise([0, *bends, len(rings) - 1])]


def cut(part: np.ndarray, z: float, *, keep_above: bool) -> np.ndarray | None:
    """Return the points of a convex part [P, 3] on one side of height z, and of its section there; None if flat."""
    above = part[:, 2] > z
    low, high = part[~above], part[above]
    kept = high if keep_above else low
    if not len(low) or not len(high):
        return kept if len(kept) else None
    # All chords between the sides: the corners of the section are among where they cross.
    share = (z - low[:, None, 2]) / (high[None, :, 2] - low[:, None, 2])
    section = low[:, None] + share[..., None] * (high[None] - low[:, None])
    points = np.concatenate([kept, section.reshape(-1, 3)])
    return points if np.ptp(points, axis=0).min() > 4 * MIN_THICKNESS else None


def draw_scaled(rng: np.random.Generator, known: Sequence[Parts]) -> Parts:
    """Return a known object, scaled along each axis."""
    scale = [*rng.uniform(*SCALE_ACROSS, 2), rng.uniform(*SCALE_UP)]
    return [part * scale for part in known[int(rng.integers(len(known)))]]


def draw_can(rng: np.random.Generator, known: Sequence[Parts]) -> Parts:
    """Return a can, cup or carton: the sides are straight."""
    del known
    height = rng.uniform(*HEIGHT)
    base, top = (1.0, rng.uniform(0.8, 1.0)) if rng.random() < 0.5 else (rng.uniform(0.65, 1.0), 1.0)
    return solid([(base, 0.0), (top, height)], _draw_outline(rng))


def draw_bottle(rng: np.random.Generator, known: Sequence[Parts]) -> Parts:
    """Return a bottle or jar with a shoulder and a neck, sometimes with a waist."""
    del known
    height, neck = rng.uniform(*HEIGHT), rng.uniform(0.3, 0.85)
    shoulder = rng.uniform(0.5, 0.75)
    above = shoulder + rng.uniform(0.08, 0.22)
    profile = [(1.0, 0.0), (1.0, shoulder), (neck, above), (neck, 1.0)]
    if rng.random() < 0.3:
        waist = rng.uniform(0.75, 0.95), rng.uniform(0.3, 0.4)
        profile = [(1.0, 0.0), (1.0, 0.6 * waist[1]), waist, (1.0, min(1.5 * waist[1], 0.95 * shoulder)), *profile[2:]]
    return solid([(factor, share * height) for factor, share in profile], _draw_outline(rng))


def draw_handled(rng: np.random.Generator, known: Sequence[Parts]) -> Parts:
    """Return a can or bottle with a handle at its side: mugs and pitchers."""
    body = (draw_can if rng.random() < 0.6 else draw_bottle)(rng, known)
    height = max(part[:, 2].max() for part in body)
    side = max(part[:, 0].max() for part in body)
    thickness, reach = rng.uniform(0.010, 0.020), rng.uniform(0.022, 0.038)
    low, high = rng.uniform(0.15, 0.35) * height, rng.uniform(0.55, 0.72) * height
    corners = [(0.8 * side, low), (side + reach, low), (side + reach, high), (0.8 * side, high)]
    return [*body, *(_rod(thickness, *ends) for ends in pairwise(corners))]


def draw_sprayer(rng: np.random.Generator, known: Sequence[Parts]) -> Parts:
    """Return a bottle whose neck carries a head that reaches out to one side, with a trigger below it."""
    body = draw_bottle(rng, known)
    height = max(part[:, 2].max() for part in body)
    length, width, depth = rng.uniform(0.05, 0.085), rng.uniform(0.02, 0.03), rng.uniform(0.02, 0.03)
    head = _box(length, width, depth) + np.array([rng.uniform(0.0, 0.3) * length, 0.0, height - 0.2 * depth])
    front = float(head[:, 0].max())
    trigger = _rod(0.01, (front - 0.012, height), (front - 0.006, height - rng.uniform(0.02, 0.04)))
    return [*body, head, trigger]


def draw_joined(rng: np.random.Generator, known: Sequence[Parts]) -> Parts:
    """Return the lower part of one object and the upper part of another: cut across, and put together."""
    lower, upper = (_draw_plain(rng, known) for _ in range(2))
    low, high = (rng.uniform(0.35, 0.7) * max(part[:, 2].max() for part in parts) for parts in (lower, upper))
    lower = [kept for part in lower if (kept := cut(part, low, keep_above=False)) is not None]
    upper = [kept - [0, 0, high] for part in upper if (kept := cut(part, high, keep_above=True)) is not None]
    across = [max(np.ptp(part[:, :2], axis=0).min() for part in parts) for parts in (lower, upper)]
    factor = rng.uniform(0.55, 1.05) * across[0] / across[1]
    # They overlap by a millimetre, so that no slit shows.
    return [*lower, *(part * [factor, factor, 1.0] + [0, 0, low - 1e-3] for part in upper)]


FAMILIES: dict[str, tuple[Family, float]] = {
    "scaled": (draw_scaled, 0.35),
    "can": (draw_can, 0.2),
    "bottle": (draw_bottle, 0.15),
    "handled": (draw_handled, 0.1),
    "sprayer": (draw_sprayer, 0.05),
    "joined": (draw_joined, 0.15),
}
"""Families by name, each with its share of what is drawn."""


def _draw_plain(rng: np.random.Generator, known: Sequence[Parts]) -> Parts:
    return (draw_scaled, draw_can, draw_bottle)[rng.integers(3)](rng, known)


def _draw_outline(rng: np.random.Generator) -> np.ndarray:
    """Draw a round, oval or box-shaped cross-section."""
    short = rng.uniform(*SHORT_SIDE)
    if rng.random() < 0.4:
        return superellipse(short, short, 2.0, SECTIONS)
    return superellipse(short * rng.uniform(*ASPECT), short, rng.choice([2.0, 2.6, 4.0, 12.0]), SECTIONS)


def _box(length: float, width: float, height: float) -> np.ndarray:
    """Return the corners [8, 3] of a box that stands centred on the origin."""
    signs = np.stack(np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [0.0, 1.0], indexing="ij"), axis=-1).reshape(-1, 3)
    return signs * [length, width, height]


def _rod(thickness: float, start: tuple[float, float], end: tuple[float, float]) -> np.ndarray:
    """Return a six-sided rod [12, 3] m from one point (x, z) of the plane y = 0 to another."""
    along = np.subtract(end, start) / np.linalg.norm(np.subtract(end, start))
    circle = superellipse(thickness, thickness, 2.0, 6)
    ring = np.column_stack([-along[1] * circle[:, 0], circle[:, 1], along[0] * circle[:, 0]])
    return np.concatenate([ring + np.array([x, 0.0, z]) for x, z in (start, end)])
