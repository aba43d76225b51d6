"""Small mesh files of every format, good and odd, and what must come out of each."""

import base64
import json
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh
from trimesh.exchange.gltf import export_glb
from trimesh.exchange.stl import export_stl_ascii

Box = tuple[float, float, float]


class Case(NamedTuple):
    """One file and what must come of it.

    Attributes:
        file: its name.
        content: its bytes.
        size: mm, of the mesh that comes out, or None if it is refused.
        mass: kg at 300 kg/m^3.
        said: the line of the refusal, or part of the doubt about its up axis; a good mesh without doubts has none.
        beside: other files by name.
        whole: the surface must be closed.
    """

    file: str
    content: bytes
    size: Box | None = None
    mass: float = 0.0
    said: str = ""
    beside: dict[str, bytes] = {}  # noqa: RUF012 (never changed)
    whole: bool = True


U_PROFILE = [(0, 0), (80, 0), (80, 80), (60, 80), (60, 20), (20, 20), (20, 80), (0, 80)]
"""mm; 4.0 of 6.4 mm^2 of its rectangle, 0.180 kg over 150 mm."""


def prism(outline: Sequence[tuple[float, float]], height: float, start: int = 0) -> tuple[np.ndarray, list[list[int]]]:
    """Return vertices [2N, 3] m and polygons of an upright prism whose caps are one polygon each, from a corner on."""
    outline = [*outline[start:], *outline[:start]]
    n = len(outline)
    vertices = np.array([(x, y, z) for z in (0.0, height) for x, y in outline]) / 1000
    sides = [[i, (i + 1) % n, n + (i + 1) % n, n + i] for i in range(n)]
    return vertices, [list(range(n))[::-1], list(range(n, 2 * n)), *sides]


def obj(vertices: np.ndarray, polygons: list[list[int]]) -> str:
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in vertices]
    return "\n".join(lines + ["f " + " ".join(str(i + 1) for i in polygon) for polygon in polygons]) + "\n"


def ply(vertices: np.ndarray, polygons: list[list[int]], *, binary: str = "", comment: bytes = b"") -> bytes:
    form = f"binary_{binary}_endian" if binary else "ascii"
    head = [f"ply\nformat {form} 1.0\n", f"element vertex {len(vertices)}\n"]
    head += [f"property float {axis}\n" for axis in "xyz"]
    head += [f"element face {len(polygons)}\nproperty list uchar int vertex_indices\nend_header\n"]
    data = "".join(head).encode().replace(b"element vertex", comment + b"element vertex", 1)
    order = ">" if binary == "big" else "<"
    if binary:
        rows = [struct.pack(f"{order}B{len(p)}i", len(p), *p) for p in polygons]
        return data + vertices.astype(f"{order}f4").tobytes() + b"".join(rows)
    lines = [" ".join(f"{value:.6f}" for value in vertex) for vertex in vertices]
    return data + "\n".join([*lines, *(" ".join(map(str, [len(p), *p])) for p in polygons)]).encode() + b"\n"


def off(vertices: np.ndarray, polygons: list[list[int]], *, head: str = "OFF\n") -> bytes:
    lines = [" ".join(map(str, vertex)) for vertex in vertices]
    lines += [" ".join(map(str, [len(polygon), *polygon])) for polygon in polygons]
    return (f"{head}{len(vertices)} {len(polygons)} 0  # counts\n" + "\n".join(lines) + "\n").encode()


def dae(vertices: np.ndarray, polygons: list[list[int]], *, unit: float, up: str) -> bytes:
    """Return a Collada document of one polygon list, in metres times `unit`."""
    values = " ".join(map(str, (np.asarray(vertices) / unit).ravel()))
    return f"""<?xml version="1.0" encoding="utf-8"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><created>2020-01-01T00:00:00</created><modified>2020-01-01T00:00:00</modified><unit name="u" meter="{unit}"/>
<up_axis>{up}</up_axis></asset>
<library_geometries><geometry id="g"><mesh><source id="s"><float_array id="a" count="{3 * len(vertices)}">{values}
</float_array><technique_common><accessor source="#a" count="{len(vertices)}" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#s"/></vertices><polylist count="{len(polygons)}">
<input semantic="VERTEX" source="#v" offset="0"/><vcount>{" ".join(str(len(p)) for p in polygons)}</vcount>
<p>{" ".join(str(i) for p in polygons for i in p)}</p></polylist></mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="c"><node id="n"><instance_geometry url="#g"/></node></visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#c"/></scene></COLLADA>""".encode()


def gltf(accessors: list[dict[str, Any]], arrays: list[np.ndarray], **more: Any) -> tuple[dict[str, Any], bytes]:
    """Return a document of one mesh and its buffer; accessor 0 holds positions, 1 indices."""
    blobs = [array.tobytes() + bytes(-array.nbytes % 4) for array in arrays]
    starts = np.cumsum([0, *map(len, blobs)])
    views = [{"buffer": 0, "byteOffset": int(s), "byteLength": a.nbytes} for s, a in zip(starts, arrays, strict=False)]
    document = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": int(starts[-1])}],
    }
    return document | more, b"".join(blobs)


def glb(document: dict[str, Any], buffer: bytes) -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(buffer), b"BIN\0") + buffer
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


BOX = trimesh.creation.box((0.06, 0.05, 0.15))
INDICES = {"bufferView": 1, "componentType": 5123, "count": 36, "type": "SCALAR"}


def float_document(**more: Any) -> tuple[dict[str, Any], bytes]:
    positions = {"bufferView": 0, "componentType": 5126, "count": 8, "type": "VEC3"}
    return gltf([positions, INDICES], [BOX.vertices.astype("<f4"), BOX.faces.astype("<u2")], **more)


def quantized_document() -> tuple[dict[str, Any], bytes]:
    """Positions as normalized integers of the half height, 8 bytes apart."""
    corners = np.zeros((8, 4), "<i2")
    corners[:, :3] = np.round(BOX.vertices / 0.075 * 32767)
    positions = {"bufferView": 0, "componentType": 5122, "count": 8, "type": "VEC3", "normalized": True}
    document, buffer = gltf([positions, INDICES], [corners, BOX.faces.astype("<u2")])
    document["nodes"][0]["scale"] = [0.075] * 3
    document["bufferViews"][0]["byteStride"] = 8
    document["extensionsRequired"] = document["extensionsUsed"] = ["KHR_mesh_quantization"]
    return document, buffer


def sparse_document() -> tuple[dict[str, Any], bytes]:
    """Positions that are all zero but for the sparse ones: all of them."""
    where = {"bufferView": 0, "componentType": 5123}
    sparse = {"count": 8, "indices": where, "values": {"bufferView": 2}}
    positions = {"componentType": 5126, "count": 8, "type": "VEC3", "sparse": sparse}
    arrays = [np.arange(8, dtype="<u2"), BOX.faces.astype("<u2"), BOX.vertices.astype("<f4")]
    return gltf([positions, INDICES], arrays)


def strip_document() -> tuple[dict[str, Any], bytes]:
    document, _ = float_document()
    strip = np.array([0, 1, 2, 3, 7, 1, 5, 0, 4, 2, 6, 7, 4, 5], "<u2")
    document["accessors"][1] = INDICES | {"count": len(strip)}
    document["meshes"][0]["primitives"][0]["mode"] = 5
    return gltf(document["accessors"], [BOX.vertices.astype("<f4"), strip], meshes=document["meshes"])


def draco_box() -> bytes:
    return export_glb(trimesh.Scene(BOX), extension_draco=True)


def turned(document: dict[str, Any]) -> dict[str, Any]:
    """Turn the scene by 90 degrees about z and mirror it."""
    document["nodes"][0]["rotation"] = [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]
    document["nodes"][0]["scale"] = [-1.0, 1.0, 1.0]
    return document


def foot_and_post(*, relative: bool) -> str:
    """A post on a foot whose vertices stand between its faces, as exporters that write part by part put them."""
    lines, count = [], 0
    for size, z in (((0.1, 0.06, 0.05), 0.025), ((0.04, 0.04, 0.15), 0.125)):
        part = trimesh.creation.box(size)
        part.apply_translation((0, 0, z))
        lines += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in part.vertices]
        lines += ["f " + " ".join(str(i - 8 if relative else i + 1 + count) for i in face) for face in part.faces]
        count += 8
    return "\n".join(lines) + "\n"


def lying_mug() -> trimesh.Trimesh:
    """A mug as glTF has it, y up: 116 mm wide, so that on its side it is tall enough to be taken."""
    mug = trimesh.creation.cylinder(0.058, 0.12, sections=48)
    mug.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0)))
    return mug


BOX_OBJ = obj(BOX.vertices, BOX.faces.tolist())
SIZE, MASS = (60.0, 50.0, 150.0), 0.135
POST = (100.0, 60.0, 200.0)
U_SIZE, U_MASS = (80.0, 80.0, 150.0), 0.180
KEYHOLE = [(0, 0), (80, 0), (80, 80), (0, 80), (0, 0), (20, 20), (20, 60), (60, 60), (60, 20), (20, 20)]
"""mm; a square ring as one outline that goes in and out through a slit: 4.8 of 6.4 mm^2, 0.216 kg over 150 mm."""
FLAT_CORNERS = [(0, 0), (20, 0), (40, 0), (80, 0), (80, 50), (60, 50), (30, 50), (0, 50), (0, 10)]
LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 1331679\n"
STRIP_PLY = ply(BOX.vertices, [[0, 1, 2, 3, 7, 1, 5, 0, 4, 2, 6, 7, 4, 5, -1, -1]]).replace(
    b"element face 1\nproperty list uchar", b"element tristrips 1\nproperty list int"
)
NOT = "allowed is a triangle mesh"


def with_uri(uri: str) -> tuple[bytes, bytes]:
    document, buffer = float_document()
    document["buffers"][0]["uri"] = uri
    return json.dumps(document).encode(), buffer


CASES: dict[str, Callable[[], Case]] = {
    # Indices.
    "obj absolute": lambda: Case("m.obj", foot_and_post(relative=False).encode(), POST, 0.162),
    "obj relative": lambda: Case("m.obj", foot_and_post(relative=True).encode(), POST, 0.162),
    "obj relative too far": lambda: Case(
        "m.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf -4 -2 -1\n", said="line 4 is no face: 'f -4 -2 -1' (vertex -4 after 3"
    ),
    "obj beyond the end": lambda: Case("m.obj", BOX_OBJ.encode() + b"f 1 2 9\n", said="a face names vertex 8 (from 0)"),
    "obj with textures": lambda: Case(
        "m.obj", BOX_OBJ.replace("f ", "vt 0 0\nf ").replace(" 1", " 1/1").encode(), SIZE, MASS
    ),
    "obj in two lines": lambda: Case("m.obj", BOX_OBJ.replace("f 1 ", "f 1 \\\n").encode(), SIZE, MASS),
    "obj not a number": lambda: Case("m.obj", b"v 0 0 x\n", said="line 1 is no vertex: 'v 0 0 x'"),
    # Polygons.
    **{
        f"obj polygon from {start}": lambda start=start: Case(
            "m.obj", obj(*prism(U_PROFILE, 150, start)).encode(), U_SIZE, U_MASS
        )
        for start in range(8)
    },
    "obj concave quad": lambda: Case(
        "m.obj", obj(*prism([(0, 0), (80, 0), (20, 20), (0, 80)], 150)).encode(), U_SIZE, 0.072
    ),
    "obj keyhole": lambda: Case("m.obj", obj(*prism(KEYHOLE, 150)).encode(), U_SIZE, 0.216, whole=False),
    "obj straight corners": lambda: Case("m.obj", obj(*prism(FLAT_CORNERS, 150)).encode(), (80.0, 50.0, 150.0), 0.180),
    "ply polygon": lambda: Case("m.ply", ply(*prism(U_PROFILE, 150, 2)), U_SIZE, U_MASS),
    "ply polygon binary": lambda: Case("m.ply", ply(*prism(U_PROFILE, 150, 4), binary="little"), U_SIZE, U_MASS),
    "off polygon": lambda: Case("m.off", off(*prism(U_PROFILE, 150, 2)), U_SIZE, U_MASS),
    "off in one line": lambda: Case("m.off", off(BOX.vertices, BOX.faces.tolist(), head="OFF "), SIZE, MASS),
    "off cut short": lambda: Case("m.off", off(BOX.vertices, BOX.faces.tolist())[:-20], said="cut short"),
    "dae polygon": lambda: Case("m.dae", dae(*prism(U_PROFILE, 150, 2), unit=0.01, up="Z_UP"), U_SIZE, U_MASS),
    "dae y up": lambda: Case(
        "m.dae", dae(BOX.vertices, BOX.faces.tolist(), unit=1.0, up="Y_UP"), SIZE, MASS, "by its .dae format it is y"
    ),
    # PLY.
    "ply big endian": lambda: Case("m.ply", ply(BOX.vertices, BOX.faces.tolist(), binary="big"), SIZE, MASS),
    "ply strip": lambda: Case("m.ply", STRIP_PLY, SIZE, MASS),
    "ply cut short": lambda: Case(
        "m.ply",
        ply(BOX.vertices, BOX.faces.tolist(), binary="little")[:-9],
        said="cut short: 12 rows of element 'face'",
    ),
    # glTF.
    "glb": lambda: Case("m.glb", glb(*float_document()), SIZE, MASS, "by its .glb format it is y"),
    "glb normalized": lambda: Case("m.glb", glb(*quantized_document()), SIZE, MASS, "it is y"),
    "glb sparse": lambda: Case("m.glb", glb(*sparse_document()), SIZE, MASS, "it is y"),
    "glb strip": lambda: Case("m.glb", glb(*strip_document()), SIZE, MASS, "it is y"),
    "glb draco": lambda: Case("m.glb", draco_box(), SIZE, MASS, "it is y"),
    "glb mirrored": lambda: Case(
        "m.glb", glb(turned(float_document()[0]), float_document()[1]), (50.0, 60.0, 150.0), MASS, "it is y"
    ),
    "glb meshopt": lambda: Case(
        "m.glb",
        glb(*float_document(extensionsRequired=["EXT_meshopt_compression", "KHR_mesh_quantization"])),
        said="not a readable .glb file: requires EXT_meshopt_compression; allowed are files without it",
    ),
    "glb basis texture": lambda: Case(
        "m.glb", glb(*float_document(extensionsRequired=["KHR_texture_basisu"])), SIZE, MASS, "it is y"
    ),
    "glb cut short": lambda: Case("m.glb", glb(*float_document())[:-40], said="cut short"),
    "glb y up": lambda: Case(
        "m.glb",
        export_glb(trimesh.Scene(lying_mug())),
        (116.0, 120.0, 116.0),
        0.3795,
        "on its side",
    ),
    "glb y up and low": lambda: Case(
        "m.glb",
        export_glb(trimesh.Scene(trimesh.creation.box((0.06, 0.15, 0.07)))),
        said="too low: 60 x 150 x 70 mm, up is z (by its .glb format, y); allowed heights",
    ),
    "glb y up and wide": lambda: Case(
        "m.glb",
        export_glb(trimesh.Scene(trimesh.creation.box((0.06, 0.22, 0.12)))),
        said="too wide: 60 x 220 x 120 mm, up is z (by its .glb format, y); allowed is a width",
    ),
    "gltf": lambda: Case("m.gltf", with_uri("a b.bin")[0], SIZE, MASS, "it is y", {"a b.bin": with_uri("")[1]}),
    "gltf embedded": lambda: Case(
        "m.gltf",
        with_uri("data:application/octet-stream;base64," + base64.b64encode(float_document()[1]).decode())[0],
        SIZE,
        MASS,
        "it is y",
    ),
    "gltf buffer outside": lambda: Case("m.gltf", with_uri("../m.bin")[0], said="leads out of the folder; allowed are"),
    "gltf buffer missing": lambda: Case("m.gltf", with_uri("m.bin")[0], said="its buffer 'm.bin' is missing; allowed"),
    # Encodings.
    "obj latin-1": lambda: Case("m.obj", ("# Größe: 150 mm\n" + BOX_OBJ).encode("latin-1"), SIZE, MASS),
    "obj utf-8 mark": lambda: Case("m.obj", ("# Größe\n" + BOX_OBJ).encode("utf-8-sig"), SIZE, MASS),
    "obj utf-16": lambda: Case("m.obj", ("# part\n" + BOX_OBJ).encode("utf-16"), SIZE, MASS),
    "obj old line ends": lambda: Case("m.obj", BOX_OBJ.replace("\n", "\r").encode(), SIZE, MASS),
    "ply latin-1": lambda: Case(
        "m.ply", ply(BOX.vertices, BOX.faces.tolist(), comment="comment Größe\n".encode("latin-1")), SIZE, MASS
    ),
    "stl latin-1": lambda: Case(
        "m.stl",
        export_stl_ascii(BOX).encode().replace(b"solid", "solid Größe".encode("latin-1"), 1),
        SIZE,
        MASS,
    ),
    # Not meshes.
    **{
        f"lfs {suffix}": lambda suffix=suffix: Case(
            f"m{suffix}", LFS, said="a Git LFS pointer, not the mesh itself; get"
        )
        for suffix in (".obj", ".stl", ".ply", ".glb", ".gltf", ".off", ".dae")
    },
    "html": lambda: Case(
        "m.obj", b"<!DOCTYPE html><html></html>", said="an HTML page, not a mesh: the download failed"
    ),
    "empty": lambda: Case("m.ply", b"", said=f"empty file; {NOT}"),
    "points ply": lambda: Case("m.ply", ply(BOX.vertices, []), said=f"a point cloud of 8 points without faces; {NOT}"),
    "points obj": lambda: Case("m.obj", b"v 0 0 0\nv 1 0 0\n", said=f"a point cloud of 2 points without faces; {NOT}"),
    "archive": lambda: Case("m.stl", b"PK\x03\x04" + bytes(200), said="a ZIP archive, not a .stl file"),
    "wrong name": lambda: Case("m.obj", glb(*float_document()), said="a binary glTF file, not a .obj file"),
}
"""Case -> the file, and what must come out."""


def write_case(folder: Path, case: Case) -> Path:
    """Write a case into a folder and return its mesh file."""
    for name, content in {case.file: case.content, **case.beside}.items():
        (folder / name).write_bytes(content)
    return folder / case.file
