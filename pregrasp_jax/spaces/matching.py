"""Which object is which in the next picture, where whoever finds objects numbers them anew each time."""

from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

FAR = 0.3
"""m that no object moves between two pictures: a push is 0.2 m long."""

_NEVER = 1e3
"""Cost of what cannot be the same object."""

_PER_METRE, _PER_HEIGHT = 10.0, 20.0
"""What a metre of way, and one of height, weigh against a size that differs by a factor of e."""


class Things(NamedTuple):
    """Objects by what tells them apart.

    Attributes:
        xy: [N, 2] m, their middles; NaN for what is nowhere.
        size: [N] > 0, cells or pixels that show them.
        height: [N] m.
    """

    xy: np.ndarray
    size: np.ndarray
    height: np.ndarray

    def take(self, index: list[int]) -> "Things":
        """Return some of them."""
        return Things(*(values[index] for values in self))


def match(before: Things, now: Things) -> list[int | None]:
    """Return, for every object that is seen now, which one before it most likely is; None if none is left for it.

    The assignment as a whole makes way and change of size and height smallest; nothing moves farther than `FAR`. An
    object that is new takes the place of one that is gone, if that was so near.
    """
    way = np.linalg.norm(now.xy[:, None] - before.xy, axis=-1)
    size = np.abs(np.log(now.size[:, None] / before.size))
    height = np.abs(now.height[:, None] - before.height)
    cost = np.where(way <= FAR, _PER_METRE * way + size + _PER_HEIGHT * height, _NEVER)
    found: list[int | None] = [None] * len(now.xy)
    for row, column in zip(*linear_sum_assignment(cost), strict=True):
        if cost[row, column] < _NEVER:
            found[row] = int(column)
    return found
