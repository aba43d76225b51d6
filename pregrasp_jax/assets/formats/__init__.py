"""Mesh files: which formats are read, and how a file of any of them becomes a triangle surface."""

import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh

from pregrasp_jax.assets.formats.collada import read_collada
from pregrasp_jax.assets.formats.gltf import external_buffers, read_gltf
from pregrasp_jax.assets.formats.ply import read_ply
from pregrasp_jax.assets.formats.surface import Surface
from pregrasp_jax.assets.formats.text import decode, read_obj, read_off
from pregrasp_jax.messages import one_line

MAX_BYTES = 256 * 2**20
"""Largest mesh file; 2 M faces are 100 MB of binary STL."""

_LFS = b"version https://git-lfs"


def read_files(path: Path) -> list[bytes]:
    """Return the content of a mesh file, and of the buffers that a .gltf keeps beside itself.

    Raises:
        ValueError: it is too large, or names a buffer that is missing or lies outside of its folder.
        OSError: it cannot be read.
    """
    _refuse_large(path)
    data = path.read_bytes()
    if path.suffix.lower() not in (".gltf", ".glb") or what_it_is(data, path.suffix.lower()):
        return [data]
    try:
        buffers = external_buffers(data, path.parent)
    except (KeyError, IndexError, AttributeError, TypeError, RecursionError) as error:
        raise ValueError(f"not a readable {path.suffix.lower()} file: {type(error).__name__} {error}") from error
    for buffer in buffers:
        _refuse_large(buffer)
    return [data, *(buffer.read_bytes() for buffer in buffers)]


def read_surface(files: list[bytes], suffix: str) -> Surface:
    """Parse what `read_files` returned: from memory, so that a mesh file cannot make us open another one.

    Args:
        files: the mesh file, then its buffers.
        suffix: one of `SUFFIXES`.

    Raises:
        ValueError: one line about what the file is, or what is wrong with it.
    """
    if what := what_it_is(files[0], suffix):
        raise ValueError(what)
    try:
        surface = READERS[suffix](files)
    except Exception as error:
        raise ValueError(f"not a readable {suffix} file: {one_line(error)}") from error
    if len(surface.faces) == 0:
        count = len(surface.vertices)
        raise ValueError(
            f"a point cloud of {count} points without faces; allowed is a triangle mesh"
            if count
            else "empty: no vertices and no faces; allowed is a triangle mesh"
        )
    return surface


def what_it_is(data: bytes, suffix: str) -> str:
    """Return what a file is that is not of the format its name says, one line; empty if it may be."""
    start = data[:512].lstrip(b"\xef\xbb\xbf \t\r\n").lower()
    if not start:
        return "empty file; allowed is a triangle mesh"
    if start.startswith(_LFS):
        return "a Git LFS pointer, not the mesh itself; get the mesh with `git lfs pull`, allowed is a triangle mesh"
    if start.startswith((b"<!doctype html", b"<html")):
        return "an HTML page, not a mesh: the download failed; allowed is a triangle mesh"
    for magic, (name, suffixes) in _MAGIC.items():
        if data.startswith(magic) and suffix not in suffixes:
            return f"{name}, not a {suffix} file; allowed is a triangle mesh whose name ends as its content is"
    return ""


def _refuse_large(path: Path) -> None:
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise ValueError(f"file of {size / 2**20:.0f} MB; allowed are {MAX_BYTES // 2**20} MB, decimate it first")


def _read_stl(files: list[bytes]) -> Surface:
    """Read an STL; a text one is decoded here, since trimesh knows one encoding, and no binary one that is too long."""
    data = files[0]
    size = 84 + 50 * int.from_bytes(data[80:84], "little")
    if len(data) < 84 or len(data) != size:
        text = decode(data)
        if text.lstrip().lower().startswith("solid"):
            data = text.replace("\r\n", "\n").replace("\r", "\n").encode()
        elif len(data) < size:
            raise ValueError(f"cut short: {size} bytes are announced, {len(data)} are there")
        else:
            data = data[:size]
    mesh = trimesh.load_scene(io.BytesIO(data), file_type="stl", process=False).to_mesh()
    return Surface(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces))


READERS: dict[str, Callable[[list[bytes]], Surface]] = {
    ".obj": lambda files: read_obj(files[0]),
    ".stl": _read_stl,
    ".ply": lambda files: read_ply(files[0]),
    ".glb": read_gltf,
    ".gltf": read_gltf,
    ".off": lambda files: read_off(files[0]),
    ".dae": lambda files: read_collada(files[0]),
}

SUFFIXES = tuple(READERS)
"""Formats that are read."""

_MAGIC = {
    b"glTF": ("a binary glTF file", (".glb", ".gltf")),
    b"ply\n": ("a PLY file", (".ply",)),
    b"ply\r": ("a PLY file", (".ply",)),
    b"PK\x03\x04": ("a ZIP archive", ()),
    b"\x1f\x8b": ("a gzip archive", ()),
    b"\x89PNG": ("a picture", ()),
    b"\xff\xd8\xff": ("a picture", ()),
    b"<?xml": ("an XML document", (".dae",)),
}
