"""Which mask is the target's from the second picture of a trial on, whatever lies where it lay."""

from typing import NamedTuple

import numpy as np

from pregrasp_jax.deploy.masks import Masks, Target
from pregrasp_jax.deploy.view import View
from pregrasp_jax.spaces.matching import FAR, Things, match

_MOST_HIDDEN = 4.0
"""By which factor what is seen of a target may change between two pictures."""

_HEIGHT = 0.05
"""m by which its height may seem to change; a target that topples ends a trial."""


class Known(NamedTuple):
    """The objects of one picture.

    Attributes:
        names: of their masks.
        things: where they are, and how large.
        target: index of the target.
    """

    names: tuple[str, ...]
    things: Things
    target: int


def things_of(masks: Masks, depth_m: np.ndarray, view: View) -> Things:
    """Return where the masks' objects are, and how large.

    Args:
        masks: of the whole image.
        depth_m: [R, C] float32 of its cut, NaN where there is none.
        view: that cuts.
    """
    place, count = view.camera.world_from_optical[:3, 3], len(masks.masks)
    things = Things(np.full((count, 2), np.nan), np.ones(count), np.full(count, np.nan))
    depth, rays = depth_m.ravel(), view.rays.reshape(3, -1)
    for index, mask in enumerate(masks.masks):
        pixels = np.flatnonzero(view.cut(mask))
        pixels = pixels[np.isfinite(depth[pixels])]
        if len(pixels):
            x, y, z = np.median(place[:, None] + rays[:, pixels] * depth[pixels], axis=1)
            things.xy[index], things.size[index], things.height[index] = (x, y), len(pixels), z
    return things


def find_target(wanted: Target, masks: Masks, things: Things, before: Known | None) -> int:
    """Return the index of the target's mask.

    The first picture decides by what was asked for. Later a name that only one mask has, then and now, is enough. An
    index, a pixel, or a name of several belongs to another object once things have moved, so the target is the mask
    that `match` takes for it, if it could be.

    Raises:
        ValueError: there is no such mask; the line says what there is.
    """
    if before is None:
        return wanted.find(masks)
    then, now = _candidates(wanted, before.names), _candidates(wanted, masks.names)
    if not now or (wanted.name is not None and len(then) == len(now) == 1):
        return wanted.find(masks)
    for index, was in zip(now, match(before.things.take(then), things.take(now)), strict=True):
        if was is not None and then[was] == before.target and _alike(before.things, before.target, things, index):
            return index
    x, y = before.things.xy[before.target]
    raise ValueError(
        f"the target was last seen at ({x:.3f}, {y:.3f}) m and is none of the {len(now)} masks that could be it now; "
        f"allowed is one within {FAR} m of there and of about its size and height"
    )


def _candidates(wanted: Target, names: tuple[str, ...]) -> list[int]:
    """Return which masks may be the target by their names."""
    return [index for index, name in enumerate(names) if wanted.name in (None, name)]


def _alike(before: Things, was: int, now: Things, index: int) -> bool:
    """Return whether what is seen now may be what was seen then: a hand may hide much of it, but not all."""
    size = max(now.size[index] / before.size[was], before.size[was] / now.size[index])
    return size <= _MOST_HIDDEN and abs(now.height[index] - before.height[was]) <= _HEIGHT
