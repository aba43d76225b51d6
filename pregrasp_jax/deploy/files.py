"""Images and masks that other programs write: a camera driver, a network. Each file is read anew at every look."""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from pregrasp_jax.deploy.devices import DeviceError, Frame
from pregrasp_jax.deploy.masks import Masks, from_mask_rcnn
from pregrasp_jax.messages import one_line


class FileSource:
    """A depth camera whose driver keeps writing one file, whole (to another name, then renamed)."""

    def __init__(self, depth: Path, color: Path | None = None, *, fresh: bool, patience_s: float = 5.0):
        """Remember the files; they are read by `capture`.

        Args:
            depth: .npy, or .png of 16 bits.
            color: .png; None without one.
            fresh: an image must be written after it is asked for: the arm may have moved before. One that lies there
                already is not, whatever its writer's clock says. Otherwise any that has not been read will do.
            patience_s: how long such an image is waited for.
        """
        self._depth, self._color, self._patience = depth, color, patience_s
        self._fresh, self._last = fresh, 0.0

    def capture(self) -> tuple[np.ndarray, np.ndarray | None, float]:
        """Return the newest image; see `ImageSource.capture`."""
        after = time.time() if self._fresh else self._last
        there = _written(self._depth) if self._fresh else None

        def is_new(written: float) -> bool:
            return written > after and written != there

        self._last = _wait(self._depth, is_new, "depth image", self._patience)
        color = read_image(self._color) if self._color else None
        return read_depth(self._depth), color, self._last


class FileSegmenter:
    """Masks that a network keeps writing, one image after the other."""

    def __init__(self, path: Path, *, min_score: float, fresh: bool, patience_s: float = 5.0):
        """Remember the file; it is read by `segment`.

        Args:
            path: .npz, or .png of instance ids.
            min_score: of masks that count.
            fresh: masks must be of an image that is no older than the one asked about: the arm may have moved before.
                Otherwise any that are not older than it will do.
            patience_s: how long masks are waited for, each time.
        """
        self._path, self._min_score, self._fresh, self._patience = path, min_score, fresh, patience_s

    def segment(self, frame: Frame) -> Masks:
        """Return the masks of a frame; see `Segmenter.segment`.

        A network that takes a second writes masks of an image that is a second old. So the first that are no older than
        the frame may be of an earlier image; the next are not, for they were begun after the first were written.
        """
        first = self._wait(lambda written: written >= frame.time_s)
        if self._fresh:
            self._wait(lambda written: written > first)
        return read_masks(self._path, min_score=self._min_score)

    def _wait(self, is_new: Callable[[float], bool]) -> float:
        return _wait(self._path, is_new, "file of masks", self._patience)


def _written(path: Path) -> float | None:
    """Return when a file has been written, s since 1970; None if it is not there."""
    return path.stat().st_mtime if path.is_file() else None


def _wait(path: Path, is_new: Callable[[float], bool], what: str, patience_s: float) -> float:
    """Wait until a file has been written anew, and return when that was, s since 1970."""
    begun = time.monotonic()
    while (written := _written(path)) is None or not is_new(written):
        if time.monotonic() - begun > patience_s:
            raise DeviceError(f"no new {what} in {path} for {patience_s:g} s; is its writer running?")
        time.sleep(0.02)
    return written


def read_depth(path: Path) -> np.ndarray:
    """Return a depth image as it was written.

    Raises:
        ValueError: it cannot be read, or is of a kind that holds no depth.
    """
    if path.suffix == ".npy":
        return _load(path)
    image = read_image(path)
    if image.ndim != 2 or image.dtype == np.uint8:
        raise ValueError(
            f"{path} is a picture of {image.dtype}{list(image.shape)}; allowed is a 16-bit grey .png, or .npy"
        )
    return image.astype(np.uint16) if image.dtype.kind == "i" and image.min() >= 0 else image


def read_image(path: Path) -> np.ndarray:
    """Return the pixels of a picture.

    Raises:
        ValueError: it cannot be read.
    """
    try:
        with Image.open(path) as image:
            return np.array(image)
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} cannot be read as a picture ({one_line(error)})") from None


def read_masks(path: Path, *, min_score: float = 0.5) -> Masks:
    """Return the masks of a file: .npz of masks, labels, scores (and names), or .png of instance ids.

    Raises:
        ValueError: it cannot be read, or holds something else.
    """
    if path.suffix == ".npz":
        held = _load(path)
        try:
            names = _names(held.pop("names")) if "names" in held else None
            return from_mask_rcnn(held, names, min_score=min_score)
        except (AttributeError, TypeError, ValueError) as error:
            raise ValueError(
                f"{path} holds no masks ({one_line(error)}); allowed are masks, labels (whole numbers), scores and, as "
                "JSON, names of labels"
            ) from None
    ids = read_image(path)
    if ids.ndim != 2:
        raise ValueError(f"{path} has shape {list(ids.shape)}; allowed is a grey .png of instance ids, 0 for the table")
    return masks_of_ids(ids)


def _names(text: np.ndarray) -> dict[int, str]:
    return {int(label): str(name) for label, name in json.loads(str(text)).items()}


def masks_of_ids(ids: np.ndarray) -> Masks:
    """Return the masks of an image of instance ids, which are their names; 0 is the table."""
    found = [int(value) for value in np.unique(ids) if value]
    masks = np.stack([ids == value for value in found]) if found else np.zeros((0, *ids.shape), bool)
    return Masks(masks, tuple(map(str, found)), np.ones(len(found)))


def _load(path: Path) -> Any:
    """Return an array, or the arrays of an npz by name. Nothing is unpickled."""
    try:
        loaded = np.load(path, allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            return loaded
        with loaded:
            return {name: loaded[name] for name in loaded.files}
    except Exception as error:  # whatever is wrong with the file: zipfile and zlib have errors of their own
        raise ValueError(f"{path} cannot be read ({one_line(error)})") from None
