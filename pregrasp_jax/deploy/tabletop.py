"""A segmenter without a network: what stands on the table, split where heights jump. For a first try.

It tells neighbours apart only where one is taller than the other by a step; objects of one height that touch become
one. Real cells want a network (`masks.from_mask_rcnn`).
"""

from collections import deque

import numpy as np

from pregrasp_jax.deploy.camera import depth_in_metres
from pregrasp_jax.deploy.contract import GridEntry
from pregrasp_jax.deploy.devices import Frame
from pregrasp_jax.deploy.masks import Masks
from pregrasp_jax.deploy.projection import cells_of, project
from pregrasp_jax.deploy.view import View
from pregrasp_jax.robot.following import Body

MIN_HEIGHT = 0.03
"""m above the table; what is lower is table."""

STEP = 0.012
"""m between neighbouring cells; more is an edge between two objects."""

_MIN_CELLS = 12
"""3 cm^2; less is no object."""


class TabletopSegmenter:
    """Components of a heightmap, as masks of the image."""

    def __init__(self, view: View, body: Body, entry: GridEntry, *, scale: float | None = None):
        self._view, self._body, self._entry, self._scale = view, body, entry, scale

    def segment(self, frame: Frame) -> Masks:
        """Return one mask per component, the largest first; none has a name of its own."""
        depth = depth_in_metres(frame.depth, scale=self._scale, shape=self._view.camera.shape)
        blank = np.zeros(depth.shape, np.uint8)
        maps = project(depth, blank, view=self._view, body=self._body, joint_pos=frame.joint_pos, entry=self._entry)
        standing = (maps.height_m > MIN_HEIGHT) & (maps.labels != self._entry.labels["robot"])
        parts = components(maps.height_m, standing)
        cells = cells_of(self._view.cut(depth), self._view)
        masks = np.zeros((len(parts), *depth.shape), bool)
        for mask, part in zip(masks, parts, strict=True):
            self._view.cut(mask)[:] = np.append(part.ravel(), False)[cells]
        sizes = np.array([part.sum() for part in parts], float)
        return Masks(masks, ("object",) * len(parts), sizes / max(sizes.max(initial=0.0), 1.0))


def components(height: np.ndarray, standing: np.ndarray) -> list[np.ndarray]:
    """Return the cells [H, W] bool of every component, the largest first: neighbours without a step between them."""
    left, found = standing.copy(), []
    while left.any():
        part = np.zeros_like(left)
        start = np.unravel_index(int(left.argmax()), left.shape)
        queue = deque([start])
        left[start], part[start] = False, True
        while queue:
            row, col = queue.popleft()
            for there in ((row - 1, col), (row + 1, col), (row, col - 1), (row, col + 1)):
                inside = 0 <= there[0] < left.shape[0] and 0 <= there[1] < left.shape[1]
                if inside and left[there] and abs(height[there] - height[row, col]) <= STEP:
                    left[there], part[there] = False, True
                    queue.append(there)
        if part.sum() >= _MIN_CELLS:
            found.append(part)
    return sorted(found, key=lambda part: -part.sum())
