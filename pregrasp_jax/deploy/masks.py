"""Instance masks with a target, from whichever segmenter, as one image of labels."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

THRESHOLD = 0.5
"""Above which a soft mask counts."""

_MIN_PIXELS = 20
"""A mask with fewer is none."""

TABLE, ROBOT = 0, 255
"""Instances that are no mask's."""


@dataclass(frozen=True)
class Masks:
    """What a segmenter has found.

    Attributes:
        masks: [N, rows, columns] bool, surest first.
        names: N texts that a target may be called by; may repeat.
        scores: [N], descending.
    """

    masks: np.ndarray
    names: tuple[str, ...]
    scores: np.ndarray


@dataclass(frozen=True, kw_only=True)
class Target:
    """Which mask is wanted: by one of its index, its name, or a pixel (column, row) that lies in it."""

    index: int | None = None
    name: str | None = None
    pixel: tuple[int, int] | None = None

    def __post_init__(self):
        if sum(x is not None for x in (self.index, self.name, self.pixel)) != 1:
            raise ValueError(f"target = {self}; allowed is one of index, name and pixel")

    def find(self, masks: Masks) -> int:
        """Return the index of the wanted mask.

        Raises:
            ValueError: there is no such mask; the line says which there are.
        """
        found = len(masks.masks)
        if found == 0:
            raise ValueError("the segmenter has found no object; allowed is at least one, the target")
        if self.index is not None:
            if not 0 <= self.index < found:
                raise ValueError(f"target index {self.index} does not exist; allowed is 0 to {found - 1}")
            return self.index
        if self.name is not None:
            if self.name not in masks.names:
                raise ValueError(
                    f"target name {self.name!r} was not found; found: {', '.join(sorted(set(masks.names)))}"
                )
            return masks.names.index(self.name)
        assert self.pixel is not None
        column, row = self.pixel
        rows, columns = masks.masks.shape[1:]
        if not (0 <= column < columns and 0 <= row < rows):
            raise ValueError(f"target pixel ({column}, {row}) is outside of the image of {columns} x {rows} pixels")
        hit = np.flatnonzero(masks.masks[:, row, column])
        if hit.size == 0:
            raise ValueError(f"target pixel ({column}, {row}) lies in none of {found} masks; allowed is one inside")
        return int(hit[0])


def refuse_size(masks: Masks, shape: tuple[int, int]) -> None:
    """Refuse masks of another image.

    Raises:
        ValueError: they have not as many rows and columns as `shape` says.
    """
    if masks.masks.shape[1:] != shape:
        raise ValueError(f"masks have shape {list(masks.masks.shape)}; allowed is N x {shape[0]} x {shape[1]}")


def fuse(masks: Masks, target: int, labels: Mapping[str, int]) -> np.ndarray:
    """Return the labels [rows, columns] uint8 of masks; where they overlap the surest one counts.

    Raises:
        ValueError: hardly anything is seen of the target.
    """
    values = [labels["target" if index == target else "obstacle"] for index in range(len(masks.masks))]
    image = _paint(masks, values, table=labels["table"])
    if (image == labels["target"]).sum() < _MIN_PIXELS:
        raise ValueError(
            f"the mask of the target has {(image == labels['target']).sum()} visible pixels; allowed is {_MIN_PIXELS}"
        )
    return image


def instance_image(masks: Masks) -> np.ndarray:
    """Return the instances [rows, columns] uint8 of masks: `TABLE`, or index + 1 of the one that counts, as in `fuse`.

    Raises:
        ValueError: too many of them.
    """
    count = len(masks.masks)
    if count >= ROBOT:
        raise ValueError(f"the segmenter has found {count} objects; allowed with a search are {ROBOT - 1}")
    return _paint(masks, range(1, count + 1), table=TABLE)


def _paint(masks: Masks, values: Sequence[int], *, table: int) -> np.ndarray:
    """Return an image [rows, columns] uint8 with a value for each mask, the surest on top."""
    image = np.full(masks.masks.shape[1:], table, np.uint8)
    for mask, value in zip(masks.masks[::-1], values[::-1], strict=True):
        image[mask] = value
    return image


def label_image(instances: np.ndarray, target_id: int, labels: Mapping[str, int]) -> np.ndarray:
    """Return the labels of an image of instance ids, of which 0 is the table.

    Raises:
        ValueError: the target is not in it.
    """
    if not (instances == target_id).any():
        raise ValueError(f"target id {target_id} is not in the image; it holds {np.unique(instances).tolist()}")
    of_object = np.where(instances == target_id, labels["target"], labels["obstacle"])
    return np.where(instances == 0, labels["table"], of_object).astype(np.uint8)


def from_mask_rcnn(output: Any, names: Mapping[int, str] | None = None, *, min_score: float = 0.5) -> Masks:
    """Return the masks of what torchvision's Mask R-CNN gives for one image, torch tensors or arrays.

    Args:
        output: the list with one dict of boxes, labels, scores and masks, or the dict; masks [N, 1, rows, columns] of 0
            to 1 as in evaluation, or [N, rows, columns] bool or uint8 as in training.
        names: label -> name; the label as text where it is missing.
        min_score: below which a detection is left out.

    Raises:
        ValueError: something else.
    """
    given = output[0] if isinstance(output, list | tuple) and len(output) == 1 else output
    if not isinstance(given, Mapping) or not {"masks", "labels"} <= set(given):
        raise ValueError("Mask R-CNN output must be a dict with masks, labels and scores, or a list with one of them")
    masks, labels = _array(given["masks"]), _array(given["labels"])
    scores = _array(given["scores"]) if "scores" in given else np.ones(len(labels))
    if masks.ndim == 4 and masks.shape[1] == 1:
        masks = masks[:, 0]
    if masks.ndim != 3 or not len(masks) == len(labels) == len(scores):
        raise ValueError(
            f"Mask R-CNN masks have shape {list(masks.shape)} for {len(labels)} labels; allowed is [N, 1, rows, "
            "columns] or [N, rows, columns]"
        )
    if labels.dtype.kind not in "iuf" or not np.isfinite(np.asarray(scores, float)).all():
        raise ValueError("Mask R-CNN labels or scores are no numbers; allowed are whole numbers, and scores of 0 to 1")
    masks = masks > THRESHOLD if masks.dtype.kind == "f" else masks.astype(bool)
    sure = np.flatnonzero(scores >= min_score)
    kept = sure[np.argsort(-scores[sure], kind="stable")]
    kept = kept[masks[kept].sum(axis=(1, 2)) >= _MIN_PIXELS] if len(kept) else kept
    called = tuple((names or {}).get(int(label), str(int(label))) for label in labels[kept])
    return Masks(masks[kept], called, np.asarray(scores[kept], float))


def _array(values: Any) -> np.ndarray:
    """Return an array of a torch tensor, on whichever device, or of anything else."""
    for method in ("detach", "cpu"):
        values = getattr(values, method)() if hasattr(values, method) else values
    return np.asarray(values)
