"""Maps of the grid as seen from above: world +x to the right and +y up, so row 0 is the bottom of the picture."""

from collections.abc import Mapping, Sequence

import numpy as np
from PIL import Image, ImageDraw

from pregrasp_jax.spaces import grid

OBSTACLE_COLORS = np.array(
    [
        [126, 148, 166],
        [163, 153, 126],
        [131, 160, 140],
        [168, 138, 138],
        [146, 134, 164],
        [112, 150, 156],
        [176, 160, 148],
        [142, 150, 120],
    ]
)
"""Muted, by slot; near enough to each other that the target stands out, far enough to tell neighbours apart."""

TARGET_COLOR, ROBOT_COLOR, TABLE_COLOR = np.array([228, 88, 36]), np.array([84, 89, 98]), np.array([226, 222, 212])


def instance_colors(target_slot: int | None) -> np.ndarray:
    """Return the colour [10, 3] of every instance id: table, eight slots, robot."""
    colors = np.concatenate([TABLE_COLOR[None], OBSTACLE_COLORS, ROBOT_COLOR[None]]).astype(float)
    if target_slot is not None:
        colors[target_slot + 1] = TARGET_COLOR
    return colors


def _stops(text: str) -> np.ndarray:
    """Return colours [17, 3], 0 to 255, that are as far apart as the values they stand for."""
    return np.array([list(bytes.fromhex(color)) for color in text.split()], float)


_CIVIDIS = _stops(
    "00224e 002e6a 1a386f 32436d 434e6c 535a6d 61656f 6f7073 7d7c78 8c8878 9b9476 aba072 bcae6c cdbb63 dec958 f0d846 "
    "fee838"
)
_INFERNO = _stops(
    "000004 0b0724 210c4a 3d0965 57106e 71196e 8a226a a32c61 bc3754 d24644 e45a31 f1731d f98e09 fcac11 f9cb35 f2ea69 "
    "fcffa4"
)
"""Perceptually uniform, also for the colour-blind: cividis (Nunez et al. 2018) and inferno (van der Walt 2015)."""


def draw_heightmap(height: np.ndarray, *, size: int = 300) -> np.ndarray:
    """Draw heights [H, W], uint8 as observed, as a map of size x size pixels; brighter is higher."""
    return as_map(_colors(np.asarray(height, np.uint8) / 255, _CIVIDIS), size)


def draw_segmentation(instance_ids: np.ndarray, *, target_slot: int | None = None, size: int = 300) -> np.ndarray:
    """Draw instance ids [H, W] in the colours of `draw_camera` as a map of size x size pixels."""
    return as_map(instance_colors(target_slot)[np.asarray(instance_ids)], size)


def draw_labels(labels: np.ndarray, names: Mapping[str, int], *, size: int = 300) -> np.ndarray:
    """Draw labels [H, W] of a fused segmentation, `names` -> value, as a map of size x size pixels."""
    of_name = {"table": TABLE_COLOR, "obstacle": OBSTACLE_COLORS[0], "target": TARGET_COLOR, "robot": ROBOT_COLOR}
    colors = np.zeros((max(names.values()) + 1, 3))
    for name, value in names.items():
        colors[value] = of_name[name]
    return as_map(colors[labels], size)


def draw_q_map(
    q: np.ndarray,
    mask: np.ndarray,
    *,
    push: tuple[Sequence[float], Sequence[float]] | None = None,
    limits: tuple[float, float] | None = None,
    backdrop: np.ndarray | None = None,
    size: int = 300,
) -> np.ndarray:
    """Draw the Q-values of one aperture.

    Args:
        q: [H, W] values; shown where `mask` holds.
        mask: [H, W] bool, where the push may end; its outline is drawn.
        push: p1 and p2, (x, y) m in the world, drawn as an arrow.
        limits: values of the darkest and the brightest colour; by default those of `q` inside the mask.
        backdrop: [H, W] uint8 heights shown faintly outside the mask.
        size: pixels of each side.

    Returns:
        [size, size, 3] uint8.
    """
    q, mask = np.asarray(q, float), np.asarray(mask, bool)
    inside = q[mask] if mask.any() else np.zeros(1)
    low, high = limits or (inside.min(), inside.max())
    colors = _colors((q - low) / max(high - low, 1e-9), _INFERNO)
    shade = np.zeros(q.shape) if backdrop is None else np.asarray(backdrop, float) / 255
    image = as_map(np.where(mask[..., None], colors, 70 + 110 * shade[..., None]), size)
    picture = Image.fromarray(image)
    canvas = ImageDraw.Draw(picture)
    fine = as_map(np.repeat(mask[..., None], 3, axis=-1) * 255.0, size)[..., 0] > 0
    padded = np.pad(fine, 1)
    interior = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    canvas.bitmap((0, 0), Image.fromarray(((fine & ~interior) * 255).astype(np.uint8)), fill=(240, 240, 240))
    if push is not None:
        _draw_arrow(canvas, *(_to_pixel(point, size) for point in push))
    return np.asarray(picture)


def _colors(values: np.ndarray, stops: np.ndarray) -> np.ndarray:
    """Return the colours [..., 3], 0 to 255, of values [...], which are clipped to [0, 1]."""
    at = np.linspace(0.0, 1.0, len(stops))
    return np.stack([np.interp(values, at, channel) for channel in stops.T], axis=-1)


def as_map(values: np.ndarray, size: int) -> np.ndarray:
    """Return cells [H, W, 3] in 0 to 255 as a picture with +y up."""
    return np.asarray(Image.fromarray(values[::-1].astype(np.uint8)).resize((size, size), Image.Resampling.NEAREST))


def _to_pixel(xy: Sequence[float], size: int) -> np.ndarray:
    """Return the picture coordinates (right, down) of a world point on a map."""
    half = grid.WORKSPACE_HALF_SIZE
    return np.array([xy[0] + half, half - xy[1]]) / (2 * half) * size


def _draw_arrow(canvas: ImageDraw.ImageDraw, start: np.ndarray, end: np.ndarray) -> None:
    along = (end - start) / max(np.linalg.norm(end - start), 1e-9)
    across = np.array([-along[1], along[0]])
    head = [tuple(end), tuple(end - 11 * along + 6 * across), tuple(end - 11 * along - 6 * across)]
    for color, width in (((0, 0, 0), 6), ((90, 220, 255), 3)):
        canvas.line([tuple(start), tuple(end - 8 * along)], fill=color, width=width)
    canvas.polygon(head, fill=(90, 220, 255), outline=(0, 0, 0))
    canvas.ellipse([*(start - 4), *(start + 4)], fill=(90, 220, 255), outline=(0, 0, 0))
