"""What a value promises: how likely an episode ends well whose best push the network values so.

Values that count coming nearer promise less than as high ones of success alone, so each kind has a table of its own. Of
success alone there are two: the less a later success is worth, the more the same value promises.
"""

from dataclasses import dataclass

import numpy as np

from pregrasp_jax.config import TaskConfig


@dataclass(frozen=True)
class Promise:
    """A table, linear in between.

    Attributes:
        values: rising, in rewards of a success.
        chances: of an episode that ends well.
    """

    values: tuple[float, ...]
    chances: tuple[float, ...]

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Return chances [...] for values [...]."""
        return np.interp(values, self.values, self.chances)


APPROACHING = Promise((0.2, 0.45, 0.6, 0.75, 1.0), (0.05, 0.25, 0.65, 0.8, 0.97))
"""Of a policy that is rewarded for coming nearer, discount 0.5 (the first one that shipped): 200 episodes on validation
scenes of built-in objects and of distorted ones."""

SUCCEEDING = {
    0.7: Promise((0.12, 0.22, 0.32, 0.4, 0.5, 0.6, 0.7, 1.0), (0.03, 0.25, 0.52, 0.63, 0.7, 0.85, 0.94, 0.97)),
    0.95: Promise((0.07, 0.12, 0.2, 0.3, 0.5, 0.7, 0.9, 1.0), (0.01, 0.04, 0.2, 0.3, 0.5, 0.75, 0.9, 0.98)),
}
"""By discount: of one that is rewarded for success alone (means of three and of six networks): 400 episodes on test
scenes of built-in seen objects and of made ones, of bank seed 24."""


def promise_of(task: TaskConfig, discount: float) -> Promise:
    """Return what the values of a policy promise.

    Args:
        task: that it was trained on.
        discount: that it was trained with. Between those that have a table chances are in between, too.
    """
    table = APPROACHING if task.approach_reward > 0 else _between(discount)
    return Promise(tuple(task.in_region_reward * value for value in table.values), table.chances)


def _between(discount: float) -> Promise:
    low, high = sorted(SUCCEEDING)
    share = np.clip((discount - low) / (high - low), 0, 1)
    values = np.array(sorted({*SUCCEEDING[low].values, *SUCCEEDING[high].values}))
    chances = (1 - share) * SUCCEEDING[low](values) + share * SUCCEEDING[high](values)
    return Promise(tuple(values.tolist()), tuple(chances.tolist()))
