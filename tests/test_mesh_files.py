"""Small peculiarities of mesh files that programs write: none of them may change what is read."""

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from pregrasp_jax.assets.formats import read_files, read_surface
from pregrasp_jax.assets.formats.surface import Surface

BOX = trimesh.creation.box((0.1, 0.2, 0.3))


def exported(suffix: str, **options: Any) -> bytes:
    data: Any = BOX.export(file_type=suffix.removeprefix("."), **options)
    return data.encode() if isinstance(data, str) else data


def read(data: bytes, suffix: str) -> Surface:
    return read_surface([data], suffix)


def assert_box(surface: Surface) -> None:
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=True)
    assert mesh.is_watertight and mesh.volume == pytest.approx(BOX.volume, rel=1e-5)


def test_a_comment_that_ends_in_a_backslash_joins_nothing():
    data = b"# by C:\\scans\\\n" + exported(".obj")
    assert len(read(data, ".obj").vertices) == len(BOX.vertices)
    assert_box(read(data, ".obj"))


def test_an_stl_with_bytes_behind_its_triangles_is_read_and_one_that_is_cut_is_said_to_be():
    data = exported(".stl")
    for behind in (b"\n", b"made by hand", bytes(50)):
        assert_box(read(data + behind, ".stl"))
    with pytest.raises(ValueError, match=rf"cut short: {len(data)} bytes are announced, {len(data) - 30} are there"):
        read(data[:-30], ".stl")


@pytest.mark.parametrize("end", [b"\n", b"\r\n", b"\r"])
def test_lines_end_as_they_like(end):
    text = io.StringIO()
    text.write("solid box\n")
    for triangle, normal in zip(BOX.triangles, BOX.face_normals, strict=True):
        text.write("facet normal {} {} {}\nouter loop\n".format(*normal))
        text.writelines("vertex {} {} {}\n".format(*corner) for corner in triangle)
        text.write("endloop\nendfacet\n")
    text.write("endsolid box\n")
    ply = exported(".ply", encoding="ascii")
    for data, suffix in ((text.getvalue().encode(), ".stl"), (ply, ".ply"), (exported(".obj"), ".obj")):
        assert_box(read(data.replace(b"\r\n", b"\n").replace(b"\n", end), suffix))


def test_a_ply_may_announce_strips_that_it_does_not_have():
    lists = b"element tristrips 0\nproperty list int int vertex_indices\nend_header\n"
    data = exported(".ply", encoding="ascii").replace(b"end_header\n", lists, 1)
    assert_box(read(data, ".ply"))
    both = data.replace(b"element tristrips 0", b"element tristrips 1") + b"\n4 0 1 2 3\n"
    with pytest.raises(ValueError, match="has faces and triangle strips; allowed is one of them"):
        read(both, ".ply")


def test_a_gltf_that_is_nested_without_end_is_one_line(tmp_path: Path):
    path = tmp_path / "deep.gltf"
    path.write_bytes(b'{"a":' + b"[" * 200_000)
    with pytest.raises(ValueError, match=r"not a readable \.gltf file"):
        read_files(path)
    assert np.isfinite(read(exported(".glb"), ".glb").vertices).all()
