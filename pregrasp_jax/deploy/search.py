"""Who may choose a push in place of the network alone: a search, which needs JAX and MuJoCo (`planned_cell`)."""

from typing import NamedTuple, Protocol

import numpy as np

from pregrasp_jax.deploy.masks import Masks
from pregrasp_jax.spaces import motion

TABLE, ROBOT = 0, 255
"""Instances of a map that are no mask's."""


class Seen(NamedTuple):
    """All that a choice may follow from.

    Attributes:
        height_m: [H, W] float32.
        instances: [H, W] uint8, `TABLE`, index + 1 of a mask, or `ROBOT`; indices of one object differ between looks.
        target: instance of the target.
        hand: commanded end of the last push.
        joint_pos: [J] rad, measured.
        pushes: made in this trial; 0 begins a new one.
    """

    height_m: np.ndarray
    instances: np.ndarray
    target: int
    hand: motion.Held
    joint_pos: np.ndarray
    pushes: int


class Search(Protocol):
    """Chooses pushes, and may remember what it has seen since the trial began."""

    def choose(self, seen: Seen) -> int:
        """Return the flat index of the push that it takes for the best.

        Raises:
            ValueError: what is seen cannot be used.
        """
        ...


def instance_image(masks: Masks, shape: tuple[int, int]) -> np.ndarray:
    """Return the instances [rows, columns] uint8 of masks; where they overlap the surest one counts, as in `fuse`.

    Raises:
        ValueError: too many of them.
    """
    count = len(masks.masks)
    if count >= ROBOT:
        raise ValueError(f"the segmenter has found {count} objects; allowed are {ROBOT - 1}")
    image = np.full(shape, TABLE, np.uint8)
    for index in reversed(range(count)):
        image[masks.masks[index]] = index + 1
    return image
