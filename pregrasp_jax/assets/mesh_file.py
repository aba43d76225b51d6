"""One mesh file: read it safely, check its size, stand it up, repair it."""

from pathlib import Path

import numpy as np
import trimesh

from pregrasp_jax.assets.decompose import repair
from pregrasp_jax.assets.formats import read_files, read_surface
from pregrasp_jax.assets.settings import SETTINGS_FILE, ObjectSettings
from pregrasp_jax.assets.standing import doubt
from pregrasp_jax.spaces.grid import MAX_HEIGHT

MIN_OBJECT_HEIGHT = 0.11
"""m; the hand pushes at 0.1 m, lower objects would pass under it."""

MAX_OBJECT_HEIGHT = MAX_HEIGHT
"""m; heightmaps end there."""

MAX_OBJECT_WIDTH = 0.2
"""m; wider objects leave no room in the 0.5 m workspace."""

MIN_OBJECT_WIDTH = 0.01
"""m; thinner objects are flat."""

_UNITS = (("millimetres", 1e-3), ("centimetres", 1e-2), ("inches", 0.0254), ("kilometres", 1e3))


def load_mesh(path: Path, settings: ObjectSettings) -> trimesh.Trimesh:
    """Read one mesh file, check it, and return it repaired, in metres, z up.

    Its metadata says in `doubt` why it may stand on the wrong side, if there is such a reason.

    Raises:
        ValueError: one line about what is wrong with it.
    """
    surface = read_surface(read_files(path), path.suffix.lower())
    used = surface.vertices[np.unique(surface.faces)]
    bad = int((~np.isfinite(used).all(axis=1)).sum())
    if bad:
        raise ValueError(f"{bad} of {len(used)} vertices are NaN or infinite; allowed are finite coordinates")
    said = surface.up if settings.up is None and surface.up != "z" else None
    hint = f" (by its {path.suffix.lower()} format, {said})" if said else ""
    _check_size(_upright(used * settings.scale, settings.up), settings, hint)
    vertices = _upright(surface.vertices * settings.scale, settings.up)
    mesh = repair(trimesh.Trimesh(vertices, surface.faces, process=False))
    if len(mesh.faces) == 0:
        raise ValueError("all faces are degenerate or duplicates; allowed is a surface that encloses a volume")
    if settings.up is None:
        mesh.metadata["doubt"] = doubt(mesh.vertices, mesh.faces, path.suffix.lower(), surface.up)
    return mesh


def _upright(vertices: np.ndarray, up: str | None) -> np.ndarray:
    """Rotate vertices so that the axis `up` becomes z: cyclic for the axis, half a turn about x for its sign."""
    up = up or "z"
    vertices = np.roll(vertices, 2 - "xyz".index(up[-1]), axis=1)
    return vertices * [1.0, -1.0, -1.0] if up.startswith("-") else vertices


def _check_size(vertices: np.ndarray, settings: ObjectSettings, up_hint: str) -> None:
    """Refuse wrong units, flat objects, and objects outside of what the task can handle."""
    size = np.ptp(vertices, axis=0)
    text = " x ".join(f"{extent * 1e3:.4g}" for extent in size) + " mm"
    if size.max() > 1.0 or size.max() < 0.01:
        hint = ", ".join(
            f"scale: {unit * settings.scale:g} if the file is in {name}"
            for name, unit in _UNITS
            if MIN_OBJECT_HEIGHT / 2 <= size.max() * unit <= 2 * MAX_OBJECT_HEIGHT
        )
        hint = hint or f"a scale that makes it {MIN_OBJECT_HEIGHT:g} to {MAX_OBJECT_HEIGHT:g} m tall"
        raise ValueError(f"wrong unit: {text}, allowed are 0.01 to 1 m; set {hint} in {SETTINGS_FILE}")
    if size.min() < MIN_OBJECT_WIDTH:
        raise ValueError(f"flat: {text}; allowed is at least {MIN_OBJECT_WIDTH * 1e3:g} mm in every direction")
    up = f"{settings.up or 'z'}{up_hint}"
    if not MIN_OBJECT_HEIGHT <= size[2] <= MAX_OBJECT_HEIGHT:
        what = "too low" if size[2] < MIN_OBJECT_HEIGHT else "too tall"
        allowed = f"allowed heights are {MIN_OBJECT_HEIGHT:g} to {MAX_OBJECT_HEIGHT:g} m"
        raise ValueError(f"{what}: {text}, up is {up}; {allowed}, scale and up can be set in {SETTINGS_FILE}")
    if size[:2].max() > MAX_OBJECT_WIDTH:
        raise ValueError(f"too wide: {text}, up is {up}; allowed is a width up to {MAX_OBJECT_WIDTH:g} m")
