"""Pictures for people: shaded views, heightmaps, Q maps, panels, animations and the contact sheet of a bank.

Everything comes from the package's own rasterizer, so no picture needs OpenGL or a display. Images are host
arrays [rows, columns, 3] uint8. Maps are shown as seen from above with world +x to the right and +y up: row 0
of a heightmap is the *bottom* of its picture.
"""

import io
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from pregrasp_jax import grid
from pregrasp_jax.heightmap import Camera, HullInstances, object_hulls, render_pinhole, unproject
from pregrasp_jax.io import write_bytes
from pregrasp_jax.types import CLOSED, MAX_OBJECTS, OPEN, ROBOT_ID, TABLE_ID, HullBank, Observation

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

_INK, _PAPER = (38, 40, 44), (250, 249, 246)
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


def instance_colors(target_slot: int | None) -> np.ndarray:
    """Return the colour [ROBOT_ID + 1, 3] of every instance id."""
    colors = np.concatenate([TABLE_COLOR[None], OBSTACLE_COLORS[:MAX_OBJECTS], ROBOT_COLOR[None]]).astype(float)
    if target_slot is not None:
        colors[target_slot + 1] = TARGET_COLOR
    assert len(colors) == ROBOT_ID + 1, "one colour per instance id"
    return colors


_render = jax.jit(render_pinhole)


def _shade(hulls: HullInstances, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return instance ids, brightness (1 = fully lit) and world points of every pixel."""
    num_hulls = hulls.labels.shape[0]
    assert num_hulls < 255, f"{num_hulls} hulls do not fit the 254 labels of a picture"
    by_hull = hulls.replace(labels=jnp.arange(1, num_hulls + 1, dtype=jnp.uint8))
    depth, labels = _render(by_hull, camera)
    points = np.asarray(unproject(jnp.minimum(depth, _FARTHEST), camera))
    labels = np.asarray(labels)
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


def draw_heightmap(height: np.ndarray, *, size: int = 300) -> np.ndarray:
    """Draw heights [H, W], uint8 as observed, as a map of size x size pixels; brighter is higher."""
    return _as_map(matplotlib.colormaps["cividis"](np.asarray(height, np.uint8))[..., :3] * 255, size)


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
    colors = matplotlib.colormaps["inferno"](np.clip((q - low) / max(high - low, 1e-9), 0, 1))[..., :3] * 255
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


def make_panel(
    hulls: HullInstances,
    obs: Observation,
    target_slot: int,
    *,
    p1: Sequence[float],
    mask: np.ndarray,
    q_values: np.ndarray | None = None,
    action: int | None = None,
    title: str = "",
) -> np.ndarray:
    """Draw scene | height | segmentation | Q closed | Q open, with the half ring and the chosen push.

    Args:
        hulls: what stands on the table (unbatched).
        obs: what the policy sees.
        target_slot: the slot of the target.
        p1: (x, y) m, where the push starts.
        mask: [H, W] bool, where it may end.
        q_values: [H, W, 2], or None for a policy without Q-values.
        action: flat index of the chosen push, drawn on the map of its aperture.
        title: one line above the panel.

    Returns:
        [rows, columns, 3] uint8.
    """
    push_aperture, push = None, None
    if action is not None:
        row, col, push_aperture = (int(x) for x in grid.decode_action(jnp.int32(action)))
        push = p1, np.asarray(grid.cell_to_world(jnp.int32(row), jnp.int32(col))).tolist()
    values = np.zeros((*np.shape(mask), 2)) if q_values is None else np.asarray(q_values)
    allowed = values[np.asarray(mask, bool)]
    limits = (allowed.min(), allowed.max()) if allowed.size else (0.0, 1.0)
    scene = draw_camera(hulls, target_slot=target_slot, camera=side_view((300, 400)))
    tiles = [("scene", scene), ("height, 0 to 0.30 m", draw_heightmap(np.asarray(obs.height)))]
    tiles.append(("segmentation", draw_segmentation(np.asarray(obs.instance_ids), target_slot=target_slot)))
    for aperture, name in ((CLOSED, "closed"), (OPEN, "open")):
        chosen = push if aperture == push_aperture else None
        image = draw_q_map(values[..., aperture], mask, push=chosen, limits=limits, backdrop=np.asarray(obs.height))
        span = "" if q_values is None else f" {limits[0]:.2f} to {limits[1]:.2f}"
        tiles.append((f"{'push' if q_values is None else 'Q'} {name}{span}", image))
    return _row(tiles, title=title, footer="maps: seen from above, +x right, +y up")


def contact_sheet(bank: HullBank, *, columns: int = 6) -> np.ndarray:
    """Draw every object of a bank with its name, size, mass, and whether it may be a target."""
    tiles = []
    for index, name in enumerate(bank.names):
        pose = jnp.array([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]])
        hulls = object_hulls(bank, jnp.array([index]), pose)
        points = np.asarray(hulls.vertices)[np.asarray(hulls.present)].reshape(-1, 3)
        wide, deep, high = np.ptp(points, axis=0)
        view = look_at((0.25, -0.62, 0.42), (0.0, 0.0, 0.115), fovy=np.deg2rad(27.0), shape=(220, 220))
        image = draw_camera(hulls, camera=view)
        eligible = "target or obstacle" if bool(np.asarray(bank.eligible)[index]) else "obstacle only"
        size = f"{wide * 100:.1f} x {deep * 100:.1f} x {high * 100:.1f} cm"
        pieces = int(np.asarray(hulls.present).sum())
        mass = f"{float(np.asarray(bank.mass)[index]):.2f} kg, {pieces} hull{'s' if pieces > 1 else ''}"
        tiles.append((f"{name}\n{size}\n{mass}\n{eligible}", image))
    rows = [_row(tiles[i : i + columns]) for i in range(0, len(tiles), columns)]
    width = max(row.shape[1] for row in rows)
    return np.concatenate([np.pad(r, ((0, 0), (0, width - r.shape[1]), (0, 0)), constant_values=250) for r in rows])


def save_png(path: Path, image: np.ndarray) -> None:
    """Write an image as PNG, whole or not at all."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="PNG")
    write_bytes(Path(path), buffer.getvalue())


def save_gif(path: Path, frames: Sequence[np.ndarray], *, seconds_per_frame: float = 1.0) -> None:
    """Write images of one shape as an endless animation, whole or not at all.

    Raises:
        ValueError: no frames.
    """
    if not frames:
        raise ValueError(f"{path}: an animation needs at least one frame")
    pictures = [Image.fromarray(frame).quantize(128, dither=Image.Dither.NONE) for frame in frames]
    buffer = io.BytesIO()
    duration = round(1000 * seconds_per_frame)
    pictures[0].save(buffer, format="GIF", save_all=True, append_images=pictures[1:], duration=duration, loop=0)
    write_bytes(Path(path), buffer.getvalue())


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
