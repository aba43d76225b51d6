"""Maps of the grid as seen from above: world +x to the right and +y up, so row 0 is the bottom of the picture."""

from collections.abc import Callable, Sequence

import numpy as np
from PIL import Image, ImageDraw

from pregrasp_jax import grid
from pregrasp_jax.drawing.shaded import instance_colors


def draw_heightmap(height: np.ndarray, *, size: int = 300) -> np.ndarray:
    """Draw heights [H, W], uint8 as observed, as a map of size x size pixels; brighter is higher."""
    return _as_map(_colormap("cividis")(np.asarray(height, np.uint8))[..., :3] * 255, size)


def draw_segmentation(instance_ids: np.ndarray, *, target_slot: int | None = None, size: int = 300) -> np.ndarray:
    """Draw instance ids [H, W] in the colours of `draw_camera` as a map of size x size pixels."""
    return _as_map(instance_colors(target_slot)[np.asarray(instance_ids)], size)


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
    colors = _colormap("inferno")(np.clip((q - low) / max(high - low, 1e-9), 0, 1))[..., :3] * 255
    shade = np.zeros(q.shape) if backdrop is None else np.asarray(backdrop, float) / 255
    image = _as_map(np.where(mask[..., None], colors, 70 + 110 * shade[..., None]), size)
    picture = Image.fromarray(image)
    canvas = ImageDraw.Draw(picture)
    fine = _as_map(np.repeat(mask[..., None], 3, axis=-1) * 255.0, size)[..., 0] > 0
    padded = np.pad(fine, 1)
    interior = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    canvas.bitmap((0, 0), Image.fromarray(((fine & ~interior) * 255).astype(np.uint8)), fill=(240, 240, 240))
    if push is not None:
        _draw_arrow(canvas, *(_to_pixel(point, size) for point in push))
    return np.asarray(picture)


def _colormap(name: str) -> Callable[[np.ndarray], np.ndarray]:
    """Return values (uint8, or 0 to 1) -> RGBA in 0 to 1."""
    import matplotlib  # here, since it comments on a home folder that it cannot write

    return matplotlib.colormaps[name]


def _as_map(values: np.ndarray, size: int) -> np.ndarray:
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
