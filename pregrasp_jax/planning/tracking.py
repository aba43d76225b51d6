"""Which object is which in the next picture, where a segmenter numbers them anew each time."""

from collections.abc import Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment

from pregrasp_jax.planning.memory import Memory
from pregrasp_jax.spaces import grid
from pregrasp_jax.types import MAX_OBJECTS

TARGET_SLOT = 0
"""Of the object that is known to be the target."""

_FAR = 0.3
"""m that no object moves between two pictures: a push is 0.2 m long."""

_NEVER = 1e3
"""Cost of what cannot be the same object."""

_PER_METRE, _PER_HEIGHT = 10.0, 20.0
"""What a metre of way, and one of height, weigh against a size that differs by a factor of e."""


def slots_of(masks: Sequence[np.ndarray], height: np.ndarray, target: int, memory: Memory) -> list[int]:
    """Return the slot of every object that is seen: that of the remembered object which it is most likely to be.

    The assignment as a whole makes way and change of size and height smallest. What is new gets a free slot, or else
    that of an object which is not seen any more.

    Args:
        masks: cells [H, W] bool of N objects, at least one cell each.
        height: [H, W] m.
        target: which of them is the target; it always has `TARGET_SLOT`.
        memory: of the trial's earlier pictures, by slot.

    Raises:
        ValueError: more objects than slots.
    """
    if len(masks) > MAX_OBJECTS:
        raise ValueError(f"the map shows {len(masks)} objects; allowed with a search are {MAX_OBJECTS}")
    found = {target: TARGET_SLOT}
    others = [index for index in range(len(masks)) if index != target]
    known = [slot for slot, shape in enumerate(memory) if shape is not None and slot != TARGET_SLOT]
    costs = np.array([[_cost(masks[index], height, memory, slot) for slot in known] for index in others])
    costs = costs.reshape(len(others), len(known))
    for row, column in zip(*linear_sum_assignment(costs), strict=True):
        if costs[row, column] < _NEVER:
            found[others[row]] = known[column]
    taken = set(found.values())
    # A free slot is better than that of something that may only be hidden.
    free = sorted((slot for slot in range(MAX_OBJECTS) if slot not in taken), key=lambda slot: memory[slot] is not None)
    left = iter(slot for slot in free if slot != TARGET_SLOT)
    return [found[index] if index in found else next(left) for index in range(len(masks))]


def _cost(mask: np.ndarray, height: np.ndarray, memory: Memory, slot: int) -> float:
    """Return how unlike what is seen in the cells `mask` is to what is remembered; `_NEVER` if it is too far away."""
    shape = memory[slot]
    assert shape is not None
    way = float(np.linalg.norm(grid.cell_to_world(*np.nonzero(mask)).mean(axis=0) - shape.pose[:2]))
    if way > _FAR:
        return _NEVER
    size = abs(float(np.log(mask.sum() / len(shape.xy))))
    return _PER_METRE * way + size + _PER_HEIGHT * abs(float(height[mask].max() - shape.height.max()))
