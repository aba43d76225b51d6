"""Filmstrips: what the policy saw before every push, what it made of it, and where the hand went."""

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image

from pregrasp_jax.report.markup import Markup, element

_COLORS = 64
"""Colours of a map, which has few; its file is a third of that with all of them."""

_JPEG_QUALITY = 82


@dataclass(frozen=True)
class Step:
    """One decision, or the end of an episode.

    Attributes:
        caption: what is done.
        pictures: (caption, image [rows, columns, 3] uint8); the first is the camera view, the others are maps.
    """

    caption: str
    pictures: tuple[tuple[str, np.ndarray], ...]


@dataclass(frozen=True)
class Film:
    """One episode.

    Attributes:
        title: scene, target and how it ended; underscores are shown as spaces, here and in captions.
        success: whether it did so well.
        steps: in order, the last one is the end.
    """

    title: str
    success: bool
    steps: tuple[Step, ...]


def film_strips(films: Sequence[Film]) -> list[Markup]:
    """Return a filmstrip for every episode, in the order given."""
    return [_film_strip(film) for film in films]


def _film_strip(film: Film) -> Markup:
    title = _readable(film.title)
    strip = element("ol", *(_step(step) for step in film.steps), class_="strip")
    box = element("div", strip, class_="scroll", tabindex="0", role="region", aria_label=title)
    badge = element("span", "success" if film.success else "failure", class_="good" if film.success else "bad")
    return element("article", element("h3", badge, " ", title), box)


def _step(step: Step) -> Markup:
    (scene, view), *maps = step.pictures
    context = _readable(step.caption)
    return element(
        "li",
        element("p", context),
        _picture(view, f"{scene}: {context}", lossy=True),
        element("div", *(_map(caption, image, context) for caption, image in maps), class_="maps"),
    )


def _readable(text: str) -> str:
    return text.replace("_", " ")


def _map(caption: str, image: np.ndarray, context: str) -> Markup:
    return element("figure", _picture(image, f"{caption}: {context}", lossy=False), element("figcaption", caption))


def _picture(image: np.ndarray, alt: str, *, lossy: bool) -> Markup:
    rows, columns = image.shape[:2]
    return element("img", src=data_uri(image, lossy=lossy), alt=alt, width=str(columns), height=str(rows))


def data_uri(image: np.ndarray, *, lossy: bool) -> str:
    """Return an image as the address that contains it: JPEG, or PNG with few colours for maps."""
    picture, buffer = Image.fromarray(image), io.BytesIO()
    if lossy:
        picture.save(buffer, format="JPEG", quality=_JPEG_QUALITY, optimize=True)
    else:
        picture.quantize(_COLORS, dither=Image.Dither.NONE).save(buffer, format="PNG", optimize=True)
    kind = "jpeg" if lossy else "png"
    return f"data:image/{kind};base64,{base64.b64encode(buffer.getvalue()).decode()}"
