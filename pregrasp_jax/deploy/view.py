"""A camera with the part of its image that sees the workspace: all that a decision looks at."""

from dataclasses import dataclass

import numpy as np

from pregrasp_jax.deploy.camera import PinholeCamera
from pregrasp_jax.spaces import grid

_TOP = 0.45
"""m above the table, of the box whose view the image is cut to; higher things are clipped to 0.30 m anyway."""


@dataclass(frozen=True, eq=False)
class View:
    """A camera and its cut.

    Attributes:
        camera: as calibrated.
        rows: of pixels.
        columns: of pixels.
        rays: [3, R, C] float32, world directions at depth 1 m.
    """

    camera: PinholeCamera
    rows: slice
    columns: slice
    rays: np.ndarray

    def cut(self, image: np.ndarray) -> np.ndarray:
        """Return the part [R, C] of an image [rows, columns]."""
        return image[self.rows, self.columns]


def make_view(camera: PinholeCamera) -> View:
    """Return the part of the image that sees the workspace up to `_TOP`.

    Raises:
        ValueError: the camera does not see all of the table in the workspace.
    """
    half = grid.WORKSPACE_HALF_SIZE
    corners = np.array([(x, y, z) for x in (-half, half) for y in (-half, half) for z in (0.0, _TOP)])
    pixels, depth = camera.project(corners)
    rows, columns = camera.shape
    on_table = corners[:, 2] == 0
    inside = (depth > 0.1) & (pixels >= 0).all(axis=1) & (pixels[:, 0] <= columns - 1) & (pixels[:, 1] <= rows - 1)
    if not inside[on_table].all():
        missing = corners[on_table & ~inside][0]
        raise ValueError(
            f"the camera at {np.round(camera.world_from_optical[:3, 3], 3).tolist()} m does not see the corner "
            f"({missing[0]:g}, {missing[1]:g}) m of the workspace; allowed is a view of all of it"
        )
    used = pixels[depth > 0.1]
    low = np.maximum(np.floor(used.min(axis=0)).astype(int) - 1, 0)
    high = np.minimum(np.ceil(used.max(axis=0)).astype(int) + 2, (columns, rows))
    row_slice, column_slice = slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))
    return View(camera, row_slice, column_slice, camera.rays(row_slice, column_slice))
