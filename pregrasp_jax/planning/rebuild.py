"""From what is remembered of the objects to scenes that can be simulated: the likeliest one, and disturbed variants."""

from typing import NamedTuple

import numpy as np

from pregrasp_jax.assets.bank import DEFAULT_DENSITY, DEFAULT_FRICTION
from pregrasp_jax.planning.memory import Memory, solids_of
from pregrasp_jax.planning.separate import separate
from pregrasp_jax.planning.solids import NUM_SIDES, Frustums, hull_bank, tighten
from pregrasp_jax.scene.model import parking_poses
from pregrasp_jax.spaces import grid
from pregrasp_jax.types import MAX_OBJECTS, ROBOT_ID, TABLE_ID, HullBank, Observation

SHRINK = 0.5e-3
"""m by which objects are drawn in on all sides, lest those that touch each other overlap."""

POSITION_JITTER, TURN_JITTER, SIDE_JITTER = 2e-3, 0.04, 1.2e-3
"""m, rad, m: standard deviations of the poses of objects, and of every side of theirs, from what is seen."""

MASS_JITTER, FRICTION_JITTER = 1.6, 1.4
"""Largest factors by which variants differ from what is assumed."""

_RAYS = np.linspace(0.02, 0.3, 15)
"""Shares of the way from the table to a camera 1 m above it at which something may stand in between."""


_NOWHERE = np.array([9.0, 9.0, 0.0])


class Variants(NamedTuple):
    """V rebuilt scenes.

    Attributes:
        bank: V * MAX_OBJECTS objects.
        poses: [V, MAX_OBJECTS, 7] float32.
        known: [MAX_OBJECTS] bool, which slots hold an object.
    """

    bank: HullBank
    poses: np.ndarray
    known: np.ndarray


def draw_variants(memory: Memory, robot: np.ndarray, count: int, rng: np.random.Generator) -> Variants:
    """Return the rebuilt scene, and `count` - 1 others that look much the same.

    Args:
        memory: what is known of the objects.
        robot: [R, V, 3] m, vertices of the hulls of the robot where it stands.
        count: of scenes.
        rng: for the others.
    """
    solids, known = solids_of(memory)
    poses = np.stack([shape.pose if shape is not None else _NOWHERE for shape in memory])
    disturbed = (np.arange(count) > 0)[:, None]
    shape = (count, MAX_OBJECTS)
    grown = disturbed[..., None] * SIDE_JITTER * rng.standard_normal((*shape, NUM_SIDES)) - SHRINK
    density = DEFAULT_DENSITY * MASS_JITTER ** (disturbed * rng.uniform(-1, 1, shape))
    friction = DEFAULT_FRICTION * FRICTION_JITTER ** (disturbed * rng.uniform(-1, 1, shape))
    off = rng.standard_normal((*shape, 3)) * [POSITION_JITTER, POSITION_JITTER, TURN_JITTER]
    places = poses + disturbed[..., None] * off
    scenes = Frustums(*(np.broadcast_to(leaf, (count, *leaf.shape)) for leaf in solids))
    support = tighten(scenes.support + grown[:, :, None, None])
    separated = separate(scenes._replace(support=support), places, robot)
    joined = Frustums(*(leaf.reshape(-1, *leaf.shape[2:]) for leaf in separated))
    bank = hull_bank(joined, density=density.ravel(), friction=friction.ravel())
    hulls = np.where(np.tile(known, count)[:, None], bank.object_hulls, -1)
    standing = np.where(known[:, None], _standing(places), parking_poses()).astype(np.float32)
    return Variants(bank.replace(object_hulls=hulls), standing, known)


def hidden_cells(obs: Observation, camera: np.ndarray | None) -> np.ndarray:
    """Return the cells [H, W] bool of which nothing is seen: those of the robot, and those behind something tall.

    Args:
        obs: host arrays.
        camera: [3] m, where the camera is; None for one that looks straight down everywhere.
    """
    ids = np.asarray(obs.instance_ids)
    hidden = ids == ROBOT_ID
    if camera is None:
        return hidden
    height = grid.dequantize_height(np.asarray(obs.height))
    x, y = np.meshgrid(grid.cell_centers(), grid.cell_centers())
    for share in _RAYS:
        on_ray = np.stack([x + share * (camera[0] - x), y + share * (camera[1] - y)], axis=-1)
        row, col = (np.clip(index, 0, grid.GRID_SIZE - 1) for index in grid.world_to_cell(on_ray))
        hidden = hidden | ((ids == TABLE_ID) & (height[row, col] > share * camera[2]))
    return hidden


def _standing(poses: np.ndarray) -> np.ndarray:
    """Return poses [..., 7] of objects that stand on the table at [..., 3] x, y and heading."""
    x, y, yaw = np.moveaxis(poses, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([x, y, zero, np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)], axis=-1)
