"""Rebuilt objects must not overlap: a convex outline bridges hollows in which a neighbour may stand."""

import numpy as np

from pregrasp_jax.planning.solids import NUM_SIDES, Frustums, corners, directions, tighten

ALLOWED = 3e-4
"""m of overlap that stays."""


def separate(solids: Frustums, poses: np.ndarray) -> Frustums:
    """Return objects cut back to where they no longer overlap, along the sides where that takes least.

    Args:
        solids: [N, P] frustums in the frames of their objects.
        poses: [N, 3] m, m, rad: x, y and heading of the objects.
    """
    owner, part = np.nonzero(solids.present)
    support, height = solids.support[owner, part].copy(), solids.height[owner, part]
    world = solids.angle[owner, part] + poses[owner, 2]
    normal = directions(world)
    outward = support + (normal @ poses[owner, :2, None])[:, None, :, 0]
    flat = corners(outward, world[:, None]).reshape(len(owner), 2 * NUM_SIDES, 2)
    # How far each part lies beyond every side of each other one, m: [of whom, side, who].
    gap = np.einsum("pki,qvi->pkqv", normal, flat).min(axis=-1) - outward.max(axis=1)[:, :, None]
    widest = gap.max(axis=1)
    best = np.maximum(widest, widest.T)
    level = np.minimum(height[:, None, 1], height[None, :, 1]) - np.maximum(height[:, None, 0], height[None, :, 0])
    meets = (owner[:, None] < owner[None]) & (level > 0) & (best < -ALLOWED)
    for first, second in np.argwhere(meets):
        cut, other = (first, second) if widest[first, second] >= widest[second, first] else (second, first)
        side = int(np.argmax(gap[cut, :, other]))
        limit = support[cut, :, side].max() + gap[cut, side, other] + ALLOWED
        support[cut, :, side] = np.minimum(support[cut, :, side], limit)
    result = solids.support.copy()
    result[owner, part] = tighten(support)
    return solids._replace(support=result)
