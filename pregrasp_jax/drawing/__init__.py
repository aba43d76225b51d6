"""Pictures for people: shaded views, heightmaps, Q maps, panels, animations and the contact sheet of a bank.

Everything comes from the package's own rasterizer, so no picture needs OpenGL or a display. Images are host
arrays [rows, columns, 3] uint8.
"""

from pregrasp_jax.drawing.files import refuse_film, refuse_image, save_film, save_image
from pregrasp_jax.drawing.maps import draw_heightmap, draw_q_map, draw_segmentation
from pregrasp_jax.drawing.shaded import (
    OBSTACLE_COLORS,
    ROBOT_COLOR,
    TABLE_COLOR,
    TARGET_COLOR,
    draw_camera,
    instance_colors,
    look_at,
    side_view,
)
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
