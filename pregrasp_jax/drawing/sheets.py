"""Pictures side by side: the panel of one decision, the contact sheet of a bank."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from pregrasp_jax.drawing.maps import draw_heightmap, draw_q_map, draw_segmentation
from pregrasp_jax.drawing.shaded import draw_camera, look_at, side_view
from pregrasp_jax.heightmap import HullInstances, object_hulls
from pregrasp_jax.spaces.actions import ActionSpace
from pregrasp_jax.types import HullBank, Observation

_MAX_MAPS = 4
"""Q maps in one panel."""

_INK, _PAPER = (38, 40, 44), (250, 249, 246)
"""Colours of text and background."""


class Taken(NamedTuple):
    """An action as it is drawn.

    Attributes:
        choice: index of its Q map.
        start: (x, y) m, where it begins.
        end: (x, y) m.
    """

    choice: int
    start: tuple[float, ...]
    end: tuple[float, ...]


def make_tiles(
    hulls: HullInstances,
    obs: Observation,
    target_slot: int,
    *,
    actions: ActionSpace,
    mask: np.ndarray,
    q_values: np.ndarray | None = None,
    taken: Taken | None = None,
) -> list[tuple[str, np.ndarray]]:
    """Draw scene, height, segmentation, and one Q map per choice, with what is allowed and the chosen push.

    Args:
        hulls: what stands on the table (unbatched).
        obs: what the policy sees.
        target_slot: the slot of the target.
        actions: what an action means; of more than `_MAX_MAPS` choices the best are drawn, the chosen one among them.
        mask: [H, W, K] bool, which actions are allowed.
        q_values: [H, W, K], or None for a policy without Q-values.
        taken: the chosen action, drawn on the map of its choice.

    Returns:
        (caption, image [rows, columns, 3] uint8) of each.
    """
    choice_taken, push = (None, None) if taken is None else (taken.choice, (taken.start, taken.end))
    mask = np.asarray(mask, bool)
    values = np.zeros(mask.shape) if q_values is None else np.asarray(q_values)
    allowed = values[mask]
    limits = (allowed.min(), allowed.max()) if allowed.size else (0.0, 1.0)
    scene = draw_camera(hulls, target_slot=target_slot, camera=side_view((300, 400)))
    tiles = [("scene", scene), ("height, 0 to 0.30 m", draw_heightmap(np.asarray(obs.height)))]
    tiles.append(("segmentation", draw_segmentation(np.asarray(obs.instance_ids), target_slot=target_slot)))
    # Of many choices without values only the chosen one says anything.
    count = 1 if q_values is None and mask.shape[-1] > _MAX_MAPS else _MAX_MAPS
    best = np.where(mask, values, -np.inf).max(axis=(0, 1))
    first = np.argsort(-np.where(np.arange(len(best)) == choice_taken, np.inf, best), kind="stable")[:count]
    for choice in sorted(first):
        chosen, shown = push if choice == choice_taken else None, mask[..., choice]
        image = draw_q_map(values[..., choice], shown, push=chosen, limits=limits, backdrop=np.asarray(obs.height))
        span = "" if q_values is None else f" {limits[0]:.2f} to {limits[1]:.2f}"
        tiles.append((f"{'push' if q_values is None else 'Q'} {actions.choices[choice].name}{span}", image))
    return tiles


def make_panel(tiles: Sequence[tuple[str, np.ndarray]], *, title: str = "") -> np.ndarray:
    """Return the pictures of `make_tiles` side by side under one line of text, [rows, columns, 3] uint8."""
    return _row(tiles, title=title, footer="maps: seen from above, +x right, +y up")


def contact_sheet(bank: HullBank, eligible: np.ndarray, *, columns: int = 6) -> np.ndarray:
    """Draw every object of a bank with its name, size, mass, and whether it may be a target, `eligible` [N] bool."""
    tiles, place, upright = [], jax.jit(object_hulls), np.array([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]], np.float32)
    for index, name in enumerate(bank.names):
        hulls = place(bank, np.array([index]), upright)
        points = np.asarray(hulls.vertices)[np.asarray(hulls.present)].reshape(-1, 3)
        wide, deep, high = np.ptp(points, axis=0)
        # Wide enough for the tallest and widest objects that are taken, whichever way they are turned.
        view = look_at((0.25, -0.62, 0.42), (0.0, 0.0, 0.14), fovy=np.deg2rad(35.0), shape=(220, 220))
        image = draw_camera(hulls, camera=view)
        role = "target or obstacle" if eligible[index] else "obstacle only"
        size = f"{wide * 100:.1f} x {deep * 100:.1f} x {high * 100:.1f} cm"
        pieces = int(np.asarray(hulls.present).sum())
        mass = f"{float(np.asarray(bank.mass)[index]):.2f} kg, {pieces} hull{'s' if pieces > 1 else ''}"
        tiles.append((f"{name}\n{size}\n{mass}\n{role}", image))
    rows = [_row(tiles[i : i + columns]) for i in range(0, len(tiles), columns)]
    width = max(row.shape[1] for row in rows)
    return np.concatenate([np.pad(r, ((0, 0), (0, width - r.shape[1]), (0, 0)), constant_values=250) for r in rows])


def _row(tiles: Sequence[tuple[str, np.ndarray]], *, title: str = "", footer: str = "", gap: int = 8) -> np.ndarray:
    """Set captioned images of one height side by side."""
    font = ImageFont.load_default(13)
    lines = max(caption.count("\n") + 1 for caption, _ in tiles)
    top, caption_height, bottom = (26 if title else gap), 17 * lines + gap, (22 if footer else 0)
    width = gap + sum(image.shape[1] + gap for _, image in tiles)
    picture = Image.new("RGB", (width, top + tiles[0][1].shape[0] + caption_height + bottom), _PAPER)
    canvas = ImageDraw.Draw(picture)
    canvas.text((gap, 5), title, fill=_INK, font=ImageFont.load_default(15))
    left = gap
    for caption, image in tiles:
        picture.paste(Image.fromarray(image), (left, top))
        canvas.multiline_text((left, top + image.shape[0] + 3), caption, fill=_INK, font=font, spacing=3)
        left += image.shape[1] + gap
    canvas.text((gap, picture.height - 20), footer, fill=_INK, font=font)
    return np.asarray(picture)
