"""The object set of a run, wherever it comes from, and the table that shows it."""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from pregrasp_jax.assets.catalogue import builtin_bank
from pregrasp_jax.assets.fit import Fit
from pregrasp_jax.assets.meshes import LoadedDir, LoadingProgress, load_object_dir
from pregrasp_jax.messages import command
from pregrasp_jax.types import HullBank

MIN_OBJECTS = 5
"""The smallest scene has five objects, all different."""


def load_bank_for(
    object_dir: str | Path | None, object_set: str, *, progress: LoadingProgress | None = None
) -> HullBank:
    """Return the built-in objects, or those of a folder; refused meshes are warnings.

    Args:
        object_dir: folder of meshes, None for the built-in catalogue.
        object_set: `seen` or `unseen`.
        progress: called as (done, total, file name) after every mesh.

    Raises:
        ValueError: there is no such set, or it is too small to make scenes of.
    """
    if object_dir is None:
        return builtin_bank(object_set)
    loaded = load_object_dir(Path(object_dir), object_set, progress=progress)
    bank, refusals = loaded.bank, loaded.refusals
    if len(bank.names) < MIN_OBJECTS:
        first = f", the first: {refusals[0].name}: {refusals[0].reason}" if refusals else ""
        raise ValueError(
            f"{object_dir}: {len(bank.names)} usable '{object_set}' objects; allowed are at least {MIN_OBJECTS}. "
            f"{len(refusals)} were refused{first}; "
            f"`{command('assets', object_dir)}` lists all"
        )
    for refusal in refusals:
        warnings.warn(f"{object_dir}: {refusal.name} refused: {refusal.reason}", stacklevel=2)
    for note in loaded.notes:
        warnings.warn(f"{object_dir}: {note.name}: {note.text}", stacklevel=2)
    return bank


def format_table(loaded: LoadedDir, why_not: Sequence[str]) -> str:
    """Return a text table of the objects (hulls, size w x d x h, mass, target or why not) and of what is to be said.

    Args:
        loaded: the objects, and the meshes that are none.
        why_not: N texts, why an object cannot be a target; empty where it can.
    """
    bank, refusals = loaded.bank, loaded.refusals
    header = ("object", "hulls", "size [mm]", "mass [kg]", "target")
    rows = [header, *(_row(bank, index, why_not[index]) for index in range(len(bank.names)))]
    widths = [max(len(row[column]) for row in rows) for column in range(len(header))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    lines.append(f"{len(bank.names)} objects, {list(why_not).count('')} can be targets, {len(refusals)} refused")
    lines += _fit_lines(loaded.fits)
    lines += [f"refused: {refusal.name}: {refusal.reason}" for refusal in refusals]
    lines += [f"note: {note.name}: {note.text}" for note in loaded.notes]
    lines += [f"not used: {line}" for line in loaded.unused]
    return "\n".join(lines)


def _fit_lines(fits: Mapping[str, Fit]) -> list[str]:
    """Return one line on how far hulls are from meshes: the median, and the worst."""
    if not fits:
        return []
    parts = []
    for what, unit, values in (
        ("extents differ by", "mm", {name: fit.off * 1e3 for name, fit in fits.items()}),
        ("volumes by", "%", {name: abs(fit.volume - 1) * 100 for name, fit in fits.items() if fit.volume >= 0}),
    ):
        if values:
            worst = max(values, key=lambda name: values[name])
            median = float(np.median(list(values.values())))
            parts.append(f"{what} {median:.1f} {unit} (median) to {values[worst]:.1f} {unit} ({worst})")
    return [f"hulls against meshes: {', '.join(parts)}"]


def _row(bank: HullBank, index: int, why_not: str) -> tuple[str, ...]:
    ids = np.asarray(bank.object_hulls[index])
    points = np.asarray(bank.full.vertices)[ids[ids >= 0]].reshape(-1, 3)
    size = " x ".join(f"{extent * 1e3:.0f}" for extent in np.ptp(points, axis=0))
    target = f"no: {why_not}" if why_not else "yes"
    return bank.names[index], str(int((ids >= 0).sum())), size, f"{float(bank.mass[index]):.3f}", target
