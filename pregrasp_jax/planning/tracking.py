"""Which object is which in the next picture, where a segmenter numbers them anew each time."""

from collections.abc import Iterable, Sequence

import numpy as np

from pregrasp_jax.planning.memory import Memory
from pregrasp_jax.spaces import grid
from pregrasp_jax.spaces.matching import Things, match
from pregrasp_jax.types import MAX_OBJECTS

TARGET_SLOT = 0
"""Of the object that is known to be the target."""


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
    others = [index for index in range(len(masks)) if index != target]
    known = {slot: shape for slot, shape in enumerate(memory) if shape is not None and slot != TARGET_SLOT}
    remembered = _things((shape.pose[:2], len(shape.xy), shape.height.max()) for shape in known.values())
    seen = _things((_middle(masks[i]), masks[i].sum(), height[masks[i]].max()) for i in others)
    slots, found = list(known), {target: TARGET_SLOT}
    found |= {i: slots[was] for i, was in zip(others, match(remembered, seen), strict=True) if was is not None}
    taken = set(found.values())
    # A free slot is better than that of something that may only be hidden.
    free = sorted((slot for slot in range(MAX_OBJECTS) if slot not in taken), key=lambda slot: memory[slot] is not None)
    left = iter(slot for slot in free if slot != TARGET_SLOT)
    return [found[index] if index in found else next(left) for index in range(len(masks))]


def _middle(mask: np.ndarray) -> np.ndarray:
    return grid.cell_to_world(*np.nonzero(mask)).mean(axis=0)


def _things(rows: Iterable[tuple[np.ndarray, float, float]]) -> Things:
    """Return objects from the middle, the size and the height of each."""
    listed = list(rows)
    xy = np.array([row[0] for row in listed]).reshape(-1, 2)
    return Things(xy, np.array([row[1] for row in listed], float), np.array([row[2] for row in listed], float))
