"""Who may choose a push in place of the network alone: a search, which needs JAX and MuJoCo (`planned_cell`)."""

from typing import NamedTuple, Protocol

import numpy as np

from pregrasp_jax.spaces import motion


class Seen(NamedTuple):
    """All that a choice may follow from.

    Attributes:
        height_m: [H, W] float32.
        instances: [H, W] uint8, `masks.TABLE`, `masks.ROBOT`, or index + 1 of a mask, which differs from look to look.
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
