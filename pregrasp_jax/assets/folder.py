"""Which files of a folder are meshes, which of several is an object's, and what is not used."""

import os
import re
from collections import Counter
from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

from pregrasp_jax.assets.formats import SUFFIXES
from pregrasp_jax.assets.settings import SETTINGS_FILE, refuse_inside_objects, same_form

_DEPTH = 3
"""Folders below that of an object in which its mesh may lie: object/meshes/visual."""

_SIMPLIFIED = re.compile(r"collision|coacd|vhacd|convex|hull|_col(?![a-z])|coll\.")
"""In a name they mark meshes that somebody has simplified; the original is read where there is one."""

_UNREAD = {
    *(".3ds", ".3mf", ".abc", ".amf", ".blend", ".ctm", ".drc", ".fbx", ".iges", ".igs", ".lwo", ".max"),
    *(".msh", ".pcd", ".step", ".stp", ".usd", ".usda", ".usdc", ".usdz", ".vtk", ".vtp", ".wrl", ".x3d", ".xyz"),
}
"""Mesh formats that are not read."""

_LOOKS = {".mtl", ".png", ".jpg", ".jpeg", ".bmp", ".tga", ".tif", ".tiff", ".webp", ".dds", ".ktx2", ".exr", ".hdr"}
_DESCRIPTIONS = {".urdf", ".sdf", ".xacro", ".xml", ".config", ".pbtxt"}


class MeshFile(NamedTuple):
    """A mesh that is to be loaded.

    Attributes:
        name: of the object: that of its file without the suffix, or of its folder.
        key: path below the folder, with `/`, in Unicode's form NFC; what `objects.yaml` and refusals call it.
        path: the file.
    """

    name: str
    key: str
    path: Path


class Contents(NamedTuple):
    """What a folder holds.

    Attributes:
        meshes: in the order of their keys.
        unread: keys of meshes in formats that are not read.
        unused: lines about all other files: which, and why.
    """

    meshes: list[MeshFile]
    unread: list[str]
    unused: list[str]


def find_meshes(folder: Path, listed: Collection[str]) -> Contents:
    """Find the meshes of a folder: files in it, and one of each folder in it.

    Args:
        folder: of one object set.
        listed: the keys of `objects.yaml`; of several meshes of a folder the listed one is taken.

    Raises:
        ValueError: settings lie in the folder of an object.
    """
    entries = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    subfolders = [path for path in entries if path.is_dir() and path.suffix.lower() not in SUFFIXES]
    files = [path for path in entries if path not in subfolders]
    found = [
        MeshFile(same_form(path.stem), _key(path, folder), path) for path in files if path.suffix.lower() in SUFFIXES
    ]
    others: list[tuple[Path, str]] = []
    for subfolder in subfolders:
        inner = _files_below(subfolder)
        candidates = [path for path in inner if path.suffix.lower() in SUFFIXES]
        files += [path for path in inner if path not in candidates]
        if candidates:
            chosen = min(candidates, key=lambda path: _rank(path, folder, listed))
            found.append(MeshFile(same_form(subfolder.name), _key(chosen, folder), chosen))
            why = f"one mesh a folder is read; another one listed in {SETTINGS_FILE} is read instead"
            others += [(path, why) for path in candidates if path != chosen]
        elif not inner:
            others.append((subfolder, "empty folders"))
    refuse_inside_objects(files, folder)
    unread = [_key(path, folder) for path in files if path.suffix.lower() in _UNREAD]
    others += [(path, why) for path in files if (why := _why_unused(path))]
    return Contents(_uniquely_named(found), unread, _lines(others))


def _key(path: Path, folder: Path) -> str:
    return same_form(path.relative_to(folder).as_posix())


def _files_below(folder: Path) -> list[Path]:
    """Return the files of a folder and of those in it, without following links to folders."""
    found = []
    for place, inner, names in os.walk(folder):
        depth = len(Path(place).relative_to(folder).parts)
        inner[:] = sorted(name for name in inner if not name.startswith(".")) if depth < _DEPTH else []
        found += [Path(place) / name for name in sorted(names) if not name.startswith(".")]
    return found


def _rank(path: Path, folder: Path, listed: Collection[str]) -> tuple:
    """Order the meshes of one object: a listed one, one that is not simplified, then by format and name."""
    key = _key(path, folder)
    simplified = bool(_SIMPLIFIED.search(key.lower()))
    return key not in listed, simplified, SUFFIXES.index(path.suffix.lower()), key


def _uniquely_named(found: list[MeshFile]) -> list[MeshFile]:
    """Name objects whose names would be the same by their keys, and those that are called like such a key."""
    named = found
    while clashing := {name for name, count in Counter(mesh.name for mesh in named).items() if count > 1}:
        renamed = [mesh._replace(name=mesh.key) if mesh.name in clashing else mesh for mesh in named]
        if renamed == named:  # two keys are the same, which is refused later
            break
        named = renamed
    return sorted(named, key=lambda mesh: mesh.key)


def _why_unused(path: Path) -> str:
    """Return why a file that is no mesh is not used; empty where it is, or is refused."""
    suffix = path.suffix.lower()
    if suffix in SUFFIXES or suffix in _UNREAD or path.name == SETTINGS_FILE:
        return ""
    if suffix == ".bin" and any(path.parent.glob("*.gltf")):
        return ""
    if suffix in _LOOKS:
        return "materials and textures; only shapes are read"
    if suffix in _DESCRIPTIONS:
        return f"descriptions; scale, up, mass and friction are set in {SETTINGS_FILE}"
    return "no meshes"


def _lines(others: list[tuple[Path, str]]) -> list[str]:
    """Return one line for each reason; a name that several folders have is told once, with its number."""
    lines = []
    for why in dict.fromkeys(why for _, why in others):
        counts = Counter(path.name for path, other in others if other == why)
        names = ", ".join(name if count == 1 else f"{name} ({count} times)" for name, count in counts.items())
        lines.append(f"{names}: {why}")
    return lines
