"""Pictures and films as files: the ending of a name decides what is written, and one that says nothing is refused."""

import importlib.util
import io
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from pregrasp_jax.io import refuse_ending, write_bytes

IMAGES: dict[str, dict[str, Any]] = {
    ".png": {"format": "PNG"},
    ".jpg": {"format": "JPEG", "quality": 92, "subsampling": 0},
    ".jpeg": {"format": "JPEG", "quality": 92, "subsampling": 0},
    ".webp": {"format": "WEBP", "lossless": True},
}
"""Ending of a picture -> how Pillow writes it; captions stay legible."""

ENCODER = "av"
"""What the extra `video` installs: PyAV, whose wheels bring libx264."""

_FRAME_RATE = 10
"""1/s; players stumble over less, and a repeated frame takes a few bytes."""


def refuse_image(path: Path) -> None:
    """Refuse a name of a picture, before it is drawn.

    Raises:
        ValueError: its ending is not one of `IMAGES`.
    """
    refuse_ending(path, tuple(IMAGES))


def refuse_film(path: Path) -> None:
    """Refuse a name of a film, before anything is played for it.

    Raises:
        ValueError: its ending is not one of `FILMS`, or what encodes it is not installed.
    """
    refuse_ending(path, tuple(FILMS))
    if path.suffix.lower() == ".mp4" and importlib.util.find_spec(ENCODER) is None:
        raise ValueError(
            f'{path}: .mp4 needs {ENCODER}; install it with `pip install "pregrasp_jax[video]"`; allowed without it '
            "are .gif and .webp"
        )


def save_image(path: Path, image: np.ndarray) -> None:
    """Write an image [rows, columns, 3] uint8, whole or not at all.

    Raises:
        ValueError: see `refuse_image`.
    """
    refuse_image(path)
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, **IMAGES[path.suffix.lower()])
    write_bytes(path, buffer.getvalue())


def save_film(path: Path, frames: Sequence[np.ndarray], *, seconds_per_frame: float = 1.0) -> None:
    """Write images of one shape as a film, whole or not at all; a .gif or .webp repeats for ever.

    Raises:
        ValueError: no frames, or see `refuse_film`.
    """
    refuse_film(path)
    if not frames:
        raise ValueError(f"{path}: a film needs at least one frame")
    write_bytes(path, FILMS[path.suffix.lower()](frames, seconds_per_frame))


def _encode_gif(frames: Sequence[np.ndarray], seconds: float) -> bytes:
    pictures = [Image.fromarray(frame).quantize(128, dither=Image.Dither.NONE) for frame in frames]
    return _animate(pictures, seconds, format="GIF")


def _encode_webp(frames: Sequence[np.ndarray], seconds: float) -> bytes:
    return _animate([Image.fromarray(frame) for frame in frames], seconds, format="WEBP", quality=90)


def _animate(pictures: Sequence[Image.Image], seconds: float, **options: Any) -> bytes:
    buffer, duration = io.BytesIO(), round(1000 * seconds)
    pictures[0].save(buffer, save_all=True, append_images=pictures[1:], duration=duration, loop=0, **options)
    return buffer.getvalue()


def _encode_mp4(frames: Sequence[np.ndarray], seconds: float) -> bytes:
    """Return H.264 in the colours that every player knows, which come in blocks of two by two pixels."""
    import av

    buffer, repeats = io.BytesIO(), max(1, round(seconds * _FRAME_RATE))
    rows, columns = frames[0].shape[:2]
    with av.open(buffer, "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=_FRAME_RATE, options={"crf": "18"})
        stream.height, stream.width, stream.pix_fmt = rows + rows % 2, columns + columns % 2, "yuv420p"
        for number in range(len(frames) * repeats):
            image = np.pad(frames[number // repeats], ((0, rows % 2), (0, columns % 2), (0, 0)), mode="edge")
            picture = av.VideoFrame.from_ndarray(image, format="rgb24")
            picture.pts, picture.time_base = number, Fraction(1, _FRAME_RATE)
            container.mux(stream.encode(picture))
        container.mux(stream.encode())
    return buffer.getvalue()


FILMS: dict[str, Callable[[Sequence[np.ndarray], float], bytes]] = {
    ".gif": _encode_gif,
    ".webp": _encode_webp,
    ".mp4": _encode_mp4,
}
"""Ending of a film -> what encodes frames that are shown for so many seconds each."""
