"""Rebuilt objects overlap neither each other nor the robot: a convex outline bridges hollows in which either may be."""

import numpy as np

from pregrasp_jax.planning.solids import NUM_SIDES, Frustums, corners, directions, tighten

ALLOWED = 3e-4
"""m of overlap that stays."""

CORE = 3e-3
"""m; radius around the middle of a part that is never cut away, whatever it overlaps."""


def separate(solids: Frustums, poses: np.ndarray, robot: np.ndarray) -> Frustums:
    """Return objects cut back to where nothing overlaps, along the sides where that takes least.

    Where two of them claim the middle of a part some overlap stays: no solid would be left.

    Args:
        solids: [N, P] frustums in the frames of their objects.
        poses: [N, 3] m, m, rad: x, y and heading of the objects.
        robot: [R, V, 3] m, vertices of its hulls in the world; they stay as they are.
    """
    owner, part = np.nonzero(solids.present)
    support, height = solids.support[owner, part].copy(), solids.height[owner, part]
    world = solids.angle[owner, part] + poses[owner, 2]
    middle = corners(support[:, 1], solids.angle[owner, part]).mean(axis=1)
    core = np.einsum("pki,pi->pk", directions(solids.angle[owner, part]), middle) + CORE
    normal = directions(world)
    outward = support + (normal @ poses[owner, :2, None])[:, None, :, 0]
    flat = corners(outward, world[:, None]).reshape(len(owner), 2 * NUM_SIDES, 2)
    points = [flat, robot[..., :2]]
    levels = np.concatenate([height, np.stack([robot[..., 2].min(axis=1), robot[..., 2].max(axis=1)], axis=1)])
    # How far everything lies beyond every side of each part, m: [of whom, side, who].
    reach = np.concatenate([np.einsum("pki,qvi->pkqv", normal, set_).min(axis=-1) for set_ in points], axis=-1)
    gap = reach - outward.max(axis=1)[:, :, None]
    count, widest = len(owner), gap.max(axis=1)
    best = widest.copy()
    best[:, :count] = np.maximum(widest[:, :count], widest[:, :count].T)
    shared = np.minimum(height[:, None, 1], levels[None, :, 1]) - np.maximum(height[:, None, 0], levels[None, :, 0])
    owners = np.append(owner, np.full(len(robot), len(poses)))
    for first, second in np.argwhere((owner[:, None] < owners[None]) & (shared > 0) & (best < -ALLOWED)):
        cut, other = (first, second) if widest[first, second] >= best[first, second] else (second, first)
        side = int(np.argmax(gap[cut, :, other]))
        beyond = solids.support[owner[cut], part[cut], :, side].max() + gap[cut, side, other]
        limit = max(beyond + ALLOWED, core[cut, side])
        support[cut, :, side] = np.minimum(support[cut, :, side], limit)
    result = solids.support.copy()
    result[owner, part] = tighten(support)
    return solids._replace(support=result)
