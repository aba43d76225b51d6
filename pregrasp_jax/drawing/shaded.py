"""Shaded views of a scene with shadows, drawn by the package's own rasterizer."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from pregrasp_jax.drawing.maps import instance_colors
from pregrasp_jax.heightmap import Camera, HullInstances, render_pinhole, unproject
from pregrasp_jax.spaces import grid
from pregrasp_jax.types import TABLE_ID

_LAMP = (-0.6, -1.1, 1.5)
"""m; where the light comes from, left of the viewer."""

_SKY = 0.5
"""Share of the light that comes from everywhere and casts no shadow."""

_SHADOW_BIAS = 0.004
"""m; about a pixel of the lamp's depth image, which is how well it knows what is in front."""

_FARTHEST = 50.0
"""m; where the table ends, so that the horizon has a position."""

_BORDER, _BORDER_SHADE, _OUTSIDE_SHADE = 0.003, 0.55, 0.93
"""m, width of the line around the workspace; brightness of the line and of the table beyond it."""

_SUPERSAMPLING = 2


def look_at(position: Sequence[float], target: Sequence[float], *, fovy: float, shape: tuple[int, int]) -> Camera:
    """Return a camera at `position` that looks at `target` (m, world), upright; `fovy` in rad."""
    backward = np.subtract(position, target) / np.linalg.norm(np.subtract(position, target))
    right = np.cross([0.0, 0.0, 1.0], backward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(backward, right), backward], axis=1)
    return Camera(
        position=jnp.asarray(position, jnp.float32),
        rotation=jnp.asarray(rotation, jnp.float32),
        fovy=jnp.float32(fovy),
        shape=shape,
    )


def side_view(shape: tuple[int, int] = (360, 480)) -> Camera:
    """Return the camera of the pictures: at the table's side, the robot enters from the left, +x is right."""
    return look_at((0.08, -0.85, 0.90), (-0.06, 0.0, 0.05), fovy=np.deg2rad(36.0), shape=shape)


def draw_camera(hulls: HullInstances, *, target_slot: int | None = None, camera: Camera | None = None) -> np.ndarray:
    """Draw a shaded view with shadows, the target in its own colour.

    Args:
        hulls: what stands on the table (unbatched), at most 254 hulls.
        target_slot: the slot to highlight.
        camera: from where; `side_view` unless given. Its shape is the shape of the picture.

    Returns:
        [rows, columns, 3] uint8.
    """
    camera = camera or side_view()
    rows, columns = camera.shape
    fine = camera.replace(shape=(rows * _SUPERSAMPLING, columns * _SUPERSAMPLING))
    ids, brightness, points = _shade(hulls, fine)
    from_center = np.abs(points[..., :2]).max(axis=-1)
    on_line = np.abs(from_center - grid.WORKSPACE_HALF_SIZE) < _BORDER / 2
    of_table = np.where(on_line, _BORDER_SHADE, np.where(from_center > grid.WORKSPACE_HALF_SIZE, _OUTSIDE_SHADE, 1.0))
    brightness = np.where(ids == TABLE_ID, of_table * brightness, brightness)
    image = instance_colors(target_slot)[ids] * brightness[..., None]
    image = image.reshape(rows, _SUPERSAMPLING, columns, _SUPERSAMPLING, 3).mean(axis=(1, 3))
    return np.clip(image, 0, 255).astype(np.uint8)


@jax.jit
def _look(hulls: HullInstances, camera: Camera) -> tuple[jax.Array, jax.Array]:
    """Return which hull (1 for the first, 0 for the table) and which world point [3] is at every pixel."""
    labels = jnp.arange(1, hulls.labels.shape[0] + 1, dtype=jnp.uint8)
    depth, hull = render_pinhole(hulls.replace(labels=labels), camera)
    return hull, unproject(jnp.minimum(depth, _FARTHEST), camera)


_render = jax.jit(render_pinhole)


def _shade(hulls: HullInstances, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return instance ids, brightness (1 = fully lit) and world points of every pixel."""
    num_hulls = hulls.labels.shape[0]
    assert num_hulls < 255, f"{num_hulls} hulls do not fit the 254 labels of a picture"
    labels, points = map(np.asarray, _look(hulls, camera))
    normals = _normals(np.asarray(hulls.planes), labels, points)
    to_lamp = np.array(_LAMP) - points
    cosine = np.sum(normals * to_lamp, axis=-1) / np.linalg.norm(to_lamp, axis=-1)
    direct = np.maximum(cosine, 0) * _is_lit(hulls, points + _SHADOW_BIAS * normals)
    sky = _SKY * (0.75 + 0.25 * normals[..., 2])
    return np.concatenate([[TABLE_ID], np.asarray(hulls.labels)])[labels], sky + (1.25 - _SKY) * direct, points


def _normals(planes: np.ndarray, labels: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the outward normals [..., 3] at points on the hulls labels - 1; up where the label is 0, the table."""
    normals = np.broadcast_to([0.0, 0.0, 1.0], points.shape).copy()
    for label in np.unique(labels[labels > 0]):
        on_hull = labels == label
        hull = planes[label - 1]
        face = np.argmax(points[on_hull] @ hull[:, :3].T - hull[:, 3], axis=1)
        normals[on_hull] = hull[face, :3]
    return normals


def _is_lit(hulls: HullInstances, points: np.ndarray) -> np.ndarray:
    """Return whether the lamp sees points [..., 3], by a depth image from the lamp; beyond its cone all is lit."""
    lamp = look_at(_LAMP, (-0.1, 0.0, 0.1), fovy=np.deg2rad(50.0), shape=(768, 768))
    depth = np.asarray(_render(hulls, lamp)[0])
    local = (points - np.asarray(lamp.position)) @ np.asarray(lamp.rotation)
    distance = np.maximum(-local[..., 2], 1e-3)
    col = np.floor(local[..., 0] / distance * float(lamp.focal) + 384).astype(int)
    row = np.floor(384 - local[..., 1] / distance * float(lamp.focal)).astype(int)
    inside = (np.minimum(row, col) >= 0) & (np.maximum(row, col) < 768)
    seen = np.where(inside, depth[np.clip(row, 0, 767), np.clip(col, 0, 767)], np.inf)
    return distance < seen + _SHADOW_BIAS
