"""glTF 2.0, as one binary file or as JSON with buffers beside it: the triangles of its scene, in metres, y up.

Read are strided, sparse and normalized accessors, strips and fans, and Draco where DracoPy is installed. Materials,
cameras, skins and animations say nothing about the shape at rest.
"""

import base64
import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from scipy.spatial.transform import Rotation

from pregrasp_jax.assets.formats.extras import import_extra
from pregrasp_jax.assets.formats.surface import Surface, from_polygons, from_strips, join
from pregrasp_jax.assets.formats.text import decode

_DRACO = "KHR_draco_mesh_compression"

_SHAPES = (_DRACO, "KHR_mesh_quantization")
"""Extensions about shapes that are read."""

_LOOKS = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "MSFT_texture_", "KHR_lights_", "EXT_lights_", "KHR_xmp")
"""Beginnings of extensions that say nothing about shapes."""

_DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_POINTS_AND_LINES = (0, 1, 2, 3)
_TRIANGLES, _STRIP, _FAN = 4, 5, 6


def read_gltf(files: list[bytes]) -> Surface:
    """Read the triangles of the scene.

    Args:
        files: the file itself, then its external buffers in the order of `external_buffers`.

    Raises:
        ValueError: it requires what is not read, or is damaged.
    """
    document, chunk = _split(files[0])
    _refuse_unknown_extensions(document)
    external = iter(files[1:])
    buffers = [
        _buffer(entry, chunk if i == 0 else None, external) for i, entry in enumerate(document.get("buffers", []))
    ]
    parts = []
    for node, matrix in _placed_nodes(document):
        if "mesh" in node:
            for primitive in document["meshes"][node["mesh"]]["primitives"]:
                if primitive.get("mode", _TRIANGLES) not in _POINTS_AND_LINES:
                    parts.append(_transformed(_read_primitive(document, buffers, primitive), matrix))
    return join(parts, up="y")


def external_buffers(data: bytes, folder: Path) -> list[Path]:
    """Return the buffers that a file keeps beside itself.

    Raises:
        ValueError: it names one that is missing or lies outside of the folder.
    """
    paths = []
    for entry in _split(data)[0].get("buffers", []):
        uri = str(entry.get("uri", "data:"))
        if uri.startswith("data:"):
            continue
        path = folder / unquote(uri)
        if not path.resolve().is_relative_to(folder.resolve()):
            raise ValueError(f"its buffer {uri[:80]!r} leads out of the folder; allowed are files beside it")
        if not path.is_file():
            raise ValueError(f"its buffer {uri[:80]!r} is missing; allowed are files beside it")
        paths.append(path)
    return paths


def _split(data: bytes) -> tuple[dict[str, Any], bytes | None]:
    """Return the JSON document and the binary chunk of a file."""
    chunk = None
    if data[:4] == b"glTF":
        chunks = dict(_chunks(data))
        if b"JSON" not in chunks:
            raise ValueError("has no JSON chunk")
        data, chunk = chunks[b"JSON"], chunks.get(b"BIN\0")
    document = json.loads(decode(data))
    version = str(document.get("asset", {}).get("version", "")) if isinstance(document, dict) else ""
    if not version.startswith("2."):
        raise ValueError(f"is glTF of version {version or 'none'}; allowed is 2.0")
    return document, chunk


def _chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Yield type and content of the chunks of a binary file."""
    start = 12
    while start + 8 <= len(data):
        length, kind = struct.unpack_from("<I4s", data, start)
        if start + 8 + length > len(data):
            raise ValueError(f"cut short: {length} bytes are announced at byte {start}")
        yield kind, data[start + 8 : start + 8 + length]
        start += 8 + length


def _refuse_unknown_extensions(document: dict[str, Any]) -> None:
    required = document.get("extensionsRequired", [])
    unknown = [name for name in required if name not in _SHAPES and not name.startswith(_LOOKS)]
    if unknown:
        raise ValueError(f"requires {', '.join(unknown)}; allowed are files without it, {' and '.join(_SHAPES)}")


def _buffer(entry: dict[str, Any], chunk: bytes | None, external: Iterator[bytes]) -> bytes:
    uri = entry.get("uri")
    if uri is None:
        return chunk or b""
    return base64.b64decode(uri.partition(",")[2]) if uri.startswith("data:") else next(external)


def _placed_nodes(document: dict[str, Any]) -> Iterator[tuple[dict[str, Any], np.ndarray]]:
    """Yield every node of the scene with its matrix [4, 4]; without scenes, of all trees."""
    nodes = document.get("nodes", [])
    inner = {child for node in nodes for child in node.get("children", [])}
    roots = [index for index in range(len(nodes)) if index not in inner]
    if scenes := document.get("scenes"):
        roots = scenes[document.get("scene", 0)].get("nodes", [])
    stack = [(index, np.eye(4), 0) for index in roots]
    while stack:
        index, parent, depth = stack.pop()
        if depth > len(nodes):
            raise ValueError(f"node {index} is its own ancestor; allowed are trees")
        node = nodes[index]
        if "EXT_mesh_gpu_instancing" in node.get("extensions", {}):
            raise ValueError("requires EXT_mesh_gpu_instancing; allowed are nodes with one mesh each")
        matrix = parent @ _local_matrix(node)
        stack += [(child, matrix, depth + 1) for child in node.get("children", [])]
        yield node, matrix


def _local_matrix(node: dict[str, Any]) -> np.ndarray:
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(node.get("rotation", [0.0, 0.0, 0.0, 1.0])).as_matrix()
    matrix[:3, :3] *= node.get("scale", [1.0, 1.0, 1.0])
    matrix[:3, 3] = node.get("translation", [0.0, 0.0, 0.0])
    return matrix


def _transformed(surface: Surface, matrix: np.ndarray) -> Surface:
    """Move a surface; a mirror image is turned inside out again."""
    faces = surface.faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else surface.faces
    return Surface(surface.vertices @ matrix[:3, :3].T + matrix[:3, 3], faces)


def _read_primitive(document: dict[str, Any], buffers: list[bytes], primitive: dict[str, Any]) -> Surface:
    if _DRACO in primitive.get("extensions", {}):
        return _read_draco(document, buffers, primitive)
    vertices = _accessor(document, buffers, primitive["attributes"]["POSITION"])
    if "indices" in primitive:
        corners = _accessor(document, buffers, primitive["indices"])[:, 0].astype(int)
    else:
        corners = np.arange(len(vertices))
    mode = primitive.get("mode", _TRIANGLES)
    if mode == _STRIP:
        return from_strips(vertices, [corners])
    if mode == _FAN:
        corners = np.column_stack([np.full(len(corners) - 2, corners[0]), corners[1:-1], corners[2:]]).ravel()
    return from_polygons(vertices, np.full(len(corners) // 3, 3), corners[: len(corners) // 3 * 3])


def _read_draco(document: dict[str, Any], buffers: list[bytes], primitive: dict[str, Any]) -> Surface:
    draco = import_extra("DracoPy", _DRACO)
    extension = primitive["extensions"][_DRACO]
    decoded = draco.decode(_view(document, buffers, extension["bufferView"]))
    wanted = extension["attributes"]["POSITION"]
    vertices = next(item["data"] for item in decoded.attributes if item["unique_id"] == wanted)
    accessor = document["accessors"][primitive["attributes"]["POSITION"]]
    vertices = _unquantized(np.asarray(vertices), bool(accessor.get("normalized")))
    return from_polygons(vertices, np.full(len(decoded.faces), 3), np.asarray(decoded.faces).ravel())


def _view(document: dict[str, Any], buffers: list[bytes], index: int) -> bytes:
    view = document["bufferViews"][index]
    start = view.get("byteOffset", 0)
    data = buffers[view["buffer"]][start : start + view["byteLength"]]
    if len(data) < view["byteLength"]:
        raise ValueError(f"cut short: buffer {view['buffer']} has less than {start + view['byteLength']} bytes")
    return data


def _accessor(document: dict[str, Any], buffers: list[bytes], index: int) -> np.ndarray:
    """Return the values [count, width] of an accessor, float64."""
    entry = document["accessors"][index]
    count, width, kind = entry["count"], _WIDTHS[entry["type"]], _DTYPES[entry["componentType"]]
    rows = np.zeros((count, width), kind)
    if "bufferView" in entry:
        stride = document["bufferViews"][entry["bufferView"]].get("byteStride")
        rows = _table(document, buffers, entry, (count, width), kind, stride)
    if sparse := entry.get("sparse"):
        shape = (sparse["count"], 1)
        where = _table(document, buffers, sparse["indices"], shape, _DTYPES[sparse["indices"]["componentType"]])
        rows[where[:, 0]] = _table(document, buffers, sparse["values"], (sparse["count"], width), kind)
    elif "bufferView" not in entry:
        raise ValueError(f"accessor {index} has no data; allowed are accessors with a buffer")
    return _unquantized(rows, bool(entry.get("normalized")))


def _table(
    document: dict[str, Any],
    buffers: list[bytes],
    entry: dict[str, Any],
    shape: tuple[int, int],
    kind: str,
    stride: int | None = None,
) -> np.ndarray:
    """Return a copy of rows in a buffer view, `stride` bytes apart."""
    item = np.dtype(kind).itemsize
    data, start = _view(document, buffers, entry["bufferView"]), entry.get("byteOffset", 0)
    return np.ndarray(shape, kind, data, start, (stride or shape[1] * item, item)).copy()


def _unquantized(values: np.ndarray, normalized: bool) -> np.ndarray:
    """Return float64; normalized integers stand for -1 to 1, or 0 to 1 if they are unsigned."""
    if normalized and values.dtype.kind in "iu":
        return np.maximum(values / np.iinfo(values.dtype).max, -1.0)
    return values.astype(np.float64)
