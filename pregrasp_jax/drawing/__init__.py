"""Pictures for people: shaded views, heightmaps, Q maps, panels, animations and the contact sheet of a bank.

Everything comes from the package's own rasterizer, so no picture needs OpenGL or a display. Images are host
arrays [rows, columns, 3] uint8. Maps and files need no JAX, so what does is imported when it is asked for.
"""

import importlib
from typing import TYPE_CHECKING, Any

from pregrasp_jax.drawing.files import refuse_film, refuse_image, save_film, save_image
from pregrasp_jax.drawing.maps import (
    OBSTACLE_COLORS,
    ROBOT_COLOR,
    TABLE_COLOR,
    TARGET_COLOR,
    draw_heightmap,
    draw_labels,
    draw_q_map,
    draw_segmentation,
    instance_colors,
)

if TYPE_CHECKING:
    from pregrasp_jax.drawing.shaded import draw_camera, look_at, side_view
    from pregrasp_jax.drawing.sheets import Taken, contact_sheet, make_panel, make_tiles

__all__ = [
    "OBSTACLE_COLORS",
    "ROBOT_COLOR",
    "TABLE_COLOR",
    "TARGET_COLOR",
    "Taken",
    "contact_sheet",
    "draw_camera",
    "draw_heightmap",
    "draw_labels",
    "draw_q_map",
    "draw_segmentation",
    "instance_colors",
    "look_at",
    "make_panel",
    "make_tiles",
    "refuse_film",
    "refuse_image",
    "save_film",
    "save_image",
    "side_view",
]

_LATE = {
    **dict.fromkeys(("draw_camera", "look_at", "side_view"), "shaded"),
    **dict.fromkeys(("Taken", "contact_sheet", "make_panel", "make_tiles"), "sheets"),
}
"""What is imported when it is asked for, and where it is."""


def __getattr__(name: str) -> Any:
    if name not in _LATE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_LATE[name]}"), name)
