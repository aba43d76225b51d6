"""Which stable grasps a run of PPG learns from, be they its own or those of another run."""

from pathlib import Path

import numpy as np

from pregrasp_jax.checkpoint.run_config import stored_config
from pregrasp_jax.checkpoint.state import read_ring
from pregrasp_jax.config import Config
from pregrasp_jax.training.stroke_collection import Positives, blank_positives

SINGULATED = 0.015
"""m that a push must take an object away from its neighbours for the singulation condition."""

_SHUFFLE = 0
"""Seed of the split into training and validation, the same in every run."""


def split(positives: Positives, written: int, config: Config) -> tuple[np.ndarray, np.ndarray]:
    """Return which grasps are learnt from and which are kept for validation, as int arrays.

    Rows that a damaged checkpoint has lost are neither: no stable grasp has an aperture of zero.

    Raises:
        ValueError: too few of them meet the singulation condition.
    """
    strokes = config.strokes
    rows = np.flatnonzero(np.asarray(positives.aperture)[:written] > 0)
    if strokes.singulation:
        rows = rows[np.asarray(positives.gain)[rows] > SINGULATED]
    rows = np.random.default_rng(_SHUFFLE).permutation(rows)
    held_out = round(strokes.validation_share * len(rows))
    if len(rows) - held_out < 1:
        raise ValueError(
            f"{len(rows)} of {written} stable grasps can be learnt from (strokes.singulation = {strokes.singulation}), "
            f"and {held_out} of these are for validation (strokes.validation_share = {strokes.validation_share}); "
            "allowed is one more at least; raise strokes.positives"
        )
    return rows[held_out:], rows[:held_out]


def refuse_collection(config: Config) -> None:
    """Refuse grasps of another run that cannot be learnt from, before a run is made of them.

    Raises:
        ValueError: it is no run of this kind, has no intact checkpoint, or too few grasps.
    """
    positives = blank_positives(config.strokes.positives)
    split(positives, copy_positives(Path(config.strokes.collection or ""), positives), config)


def copy_positives(run: Path, into: Positives) -> int:
    """Copy the stable grasps that another run has collected, as many as there is room for; return how many.

    Raises:
        ValueError: it is no run of this kind, or has no intact checkpoint.
    """
    template = blank_positives(stored_config(run).strokes.positives)
    contents, written = read_ring(run / "checkpoints", template)
    written = min(written, len(into.index))
    for name in ("height", "index", "aperture", "gain"):
        getattr(into, name)[:written] = np.asarray(getattr(contents, name))[:written]
    return written
