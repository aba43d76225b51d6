"""`objects.yaml`: what a mesh file cannot say about itself.

The file lies beside the meshes. Its keys are mesh file names, and `defaults` for all of them::

    defaults: {density: 300, friction: 0.25}
    mug.stl: {scale: 0.001, up: y, mass: 0.12}

Names are compared in one Unicode form: macOS takes the accents of a file name apart, editors do not.
"""

import math
import re
import unicodedata
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from pregrasp_jax import yaml_file
from pregrasp_jax.assets.bank import DEFAULT_DENSITY, DEFAULT_FRICTION

SETTINGS_FILE = "objects.yaml"

_MEANT_AS_SETTINGS = re.compile(r"objects?\.(ya?ml|json|toml)(\.txt)?")
"""Names, in lower case, of files whose writer wanted `SETTINGS_FILE`."""

UP_AXES = ("x", "y", "z", "-x", "-y", "-z")

_RANGES = {"scale": (1e-6, 1e6), "mass": (0.005, 20.0), "density": (10.0, 20_000.0), "friction": (0.01, 5.0)}


@dataclass(frozen=True, kw_only=True)
class ObjectSettings:
    """Settings of one mesh."""

    scale: float = 1.0
    """Metres per unit of the file; 0.001 for millimetres."""
    up: str | None = None
    """The axis of the file that points up when the object stands: x, y, z, -x, -y or -z; None is z, with doubts."""
    mass: float | None = None
    """kg; None is `density` times the volume of the hulls."""
    density: float = DEFAULT_DENSITY
    """kg/m^3, used where there is no mass."""
    friction: float = DEFAULT_FRICTION
    """Sliding friction against other objects."""


def load_settings(folder: Path) -> tuple[ObjectSettings, dict[str, ObjectSettings]]:
    """Read `objects.yaml` of a folder, if there is one.

    Returns:
        The settings of unlisted meshes, and those of every listed file by name.

    Raises:
        ValueError: the file is not YAML, names a mesh twice, holds an unknown setting or a value out of range, or lies
            there under another name.
    """
    _refuse_misnamed(folder)
    path = folder / SETTINGS_FILE
    if not path.exists():
        return ObjectSettings(), {}
    content = yaml_file.read(path)
    content = _mapping(content, str(path))
    shared = _checked(content.pop("defaults", None), f"{path}: defaults")
    listed: dict[str, ObjectSettings] = {}
    for name, entry in content.items():
        settings = ObjectSettings(**_merged(shared, _checked(entry, f"{path}: {name}")))
        if listed.setdefault(same_form(str(name)), settings) is not settings:
            raise ValueError(f"{path}: {name}: stands twice, in two Unicode forms; allowed is one entry")
    return ObjectSettings(**shared), listed


def refuse_beside_sets(folder: Path, sets: Sequence[str]) -> None:
    """Refuse settings that lie beside the folders `sets`, where they would not be read.

    Raises:
        ValueError: there are some.
    """
    for path in sorted(folder.iterdir()):
        if _MEANT_AS_SETTINGS.fullmatch(path.name.lower()):
            places = " and ".join(str(folder / name / SETTINGS_FILE) for name in sets)
            raise ValueError(f"{path}: not read, since it lies beside {sets[0]}; allowed is {places}")


def refuse_inside_objects(paths: Iterable[Path], folder: Path) -> None:
    """Refuse settings among the files of objects' own folders, where they would not be read.

    Raises:
        ValueError: there are some.
    """
    for path in paths:
        if path.parent != folder and _MEANT_AS_SETTINGS.fullmatch(path.name.lower()):
            raise ValueError(f"{path}: not read; allowed is {folder / SETTINGS_FILE}, which lists {path.parent.name}")


def same_form(name: str) -> str:
    """Return a file name in the Unicode form in which names are compared (NFC)."""
    return unicodedata.normalize("NFC", name)


def _refuse_misnamed(folder: Path) -> None:
    """Refuse files that were meant as settings and are not read; warn of other YAML files."""
    for path in sorted(folder.iterdir()):
        if path.name == SETTINGS_FILE:
            if not path.is_file():
                raise ValueError(f"{path}: missing or not a file; allowed is a file of settings")
        elif _MEANT_AS_SETTINGS.fullmatch(path.name.lower()):
            raise ValueError(f"{path}: not read; the allowed name of a file of settings is {SETTINGS_FILE}")
        elif path.suffix.lower() in (".yaml", ".yml"):
            warnings.warn(f"{path}: not read; settings of meshes stand in {SETTINGS_FILE}", stacklevel=3)


def _merged(shared: dict[str, Any], entry: dict[str, Any]) -> dict[str, Any]:
    """Let an entry override the defaults; its density also overrides a default mass."""
    return {**shared, **({"mass": None} if "density" in entry else {}), **entry}


def _checked(entry: Any, where: str) -> dict[str, Any]:
    """Return a copy of one entry whose keys and values are all allowed."""
    entry = _mapping(entry, where)
    allowed = [field.name for field in fields(ObjectSettings)]
    for key, value in entry.items():
        if key not in allowed:
            raise ValueError(f"{where}: unknown setting '{key}'; allowed are {', '.join(allowed)}")
        if key == "up":
            if value not in UP_AXES:
                raise ValueError(f"{where}: up is {value!r}; allowed are {', '.join(UP_AXES)}")
            continue
        low, high = _RANGES[key]
        number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        if not number or not low <= value <= high:
            raise ValueError(f"{where}: {key} is {value!r}; allowed is a number from {low:g} to {high:g}")
    if {"mass", "density"} <= entry.keys():
        raise ValueError(f"{where}: has both mass and density; allowed is one of them")
    return entry


def _mapping(value: Any, where: str) -> dict[str, Any]:
    if value is None:
        return {}
    if not isinstance(value, Mapping):
        raise ValueError(f"{where}: is {type(value).__name__}; allowed is a mapping of names to settings")
    return dict(value)
