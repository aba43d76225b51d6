"""Rebuilt objects overlap neither each other nor the robot: a convex outline bridges hollows in which either may be."""

import numpy as np

from pregrasp_jax.planning.solids import NUM_SIDES, Frustums, corners, directions, tighten

ALLOWED = 3e-4
"""m of overlap that stays."""

CORE = 3e-3
"""m; radius around the middle of a part that is never cut away, whatever it overlaps."""


def separate(solids: Frustums, poses: np.ndarray, robot: np.ndarray) -> Frustums:
    """Return the objects of V scenes cut back to where nothing overlaps, along the sides where that takes least.

    Where two of them claim the middle of a part some overlap stays: no solid would be left.

    Args:
        solids: [V, N, P] frustums in the frames of their objects; the same ones are present in all scenes.
        poses: [V, N, 3] m, m, rad: x, y and heading of the objects.
        robot: [R, V, 3] m, vertices of its hulls in the world; they stay as they are.
    """
    owner, part = np.nonzero(solids.present[0])
    before, height, angle = (leaf[:, owner, part] for leaf in (solids.support, solids.height, solids.angle))
    support, world = before.copy(), angle + poses[:, owner, 2]
    middle = corners(support[:, :, 1], angle).mean(axis=-2)
    core = np.einsum("...ki,...i->...k", directions(angle), middle) + CORE
    normal = directions(world)
    outward = support + (normal @ poses[:, owner, :2, None])[..., None, :, 0]
    count, num_scenes = len(owner), len(poses)
    flat = corners(outward, world[..., None]).reshape(num_scenes, count, 2 * NUM_SIDES, 2)
    extent = np.stack([robot[..., 2].min(axis=1), robot[..., 2].max(axis=1)], axis=1)
    levels = np.concatenate([height, np.broadcast_to(extent, (num_scenes, *extent.shape))], axis=1)
    # How far everything lies beyond every side of each part, m: [scene, of whom, side, who].
    reach = [
        np.min(normal[:, :, None] @ np.swapaxes(points, -1, -2), axis=-1).swapaxes(-1, -2)
        for points in (flat[:, None], robot[None, None, :, :, :2])
    ]
    gap = np.concatenate(reach, axis=-1) - outward.max(axis=2)[..., None]
    widest = gap.max(axis=2)
    best = widest.copy()
    best[:, :, :count] = np.maximum(widest[..., :count], widest[..., :count].swapaxes(1, 2))
    bottom, top = np.moveaxis(levels, -1, 0)
    shared = np.minimum(top[:, :count, None], top[:, None]) - np.maximum(bottom[:, :count, None], bottom[:, None])
    owners = np.append(owner, np.full(len(robot), poses.shape[1]))
    overlaps = (owner[:, None] < owners[None]) & (shared > 0) & (best < -ALLOWED)
    for scene, first, second in np.argwhere(overlaps):
        mine = widest[scene, first, second] >= best[scene, first, second]
        cut, other = (first, second) if mine else (second, first)
        side = int(np.argmax(gap[scene, cut, :, other]))
        beyond = before[scene, cut, :, side].max() + gap[scene, cut, side, other]
        limit = max(beyond + ALLOWED, core[scene, cut, side])
        support[scene, cut, :, side] = np.minimum(support[scene, cut, :, side], limit)
    result = solids.support.copy()
    result[:, owner, part] = tighten(support)
    return solids._replace(support=result)
