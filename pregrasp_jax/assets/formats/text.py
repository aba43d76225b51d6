"""The text formats: OBJ and OFF, decoded whatever wrote them."""

import codecs
import re
from collections.abc import Iterator

import numpy as np

from pregrasp_jax.assets.formats.surface import Surface, from_polygons

_COMMENT = re.compile(r"#[^\n]*")

_MARKS = {codecs.BOM_UTF8: "utf-8", codecs.BOM_UTF16_LE: "utf-16-le", codecs.BOM_UTF16_BE: "utf-16-be"}


def decode(data: bytes) -> str:
    """Return the text of a file: by its byte order mark, else UTF-8, else Latin-1, which takes any byte."""
    for mark, encoding in _MARKS.items():
        if data.startswith(mark):
            return data[len(mark) :].decode(encoding, errors="replace")
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def read_obj(data: bytes) -> Surface:
    """Read vertices and faces of a Wavefront OBJ; groups, materials, normals and texture coordinates say nothing.

    Raises:
        ValueError: a line is not what it says it is, or a face names a vertex that is not there.
    """
    vertices: list[list[float]] = []
    sizes: list[int] = []
    corners: list[int] = []
    for number, words in _lines(data, joined=True):
        try:
            if words[0] == "v":
                x, y, z = words[1:4]
                vertices.append([float(x), float(y), float(z)])
            elif words[0] == "f":
                corners += [_corner(word, len(vertices)) for word in words[1:]]
                sizes.append(len(words) - 1)
        except ValueError as error:
            what = "vertex" if words[0] == "v" else "face"
            raise ValueError(f"line {number} is no {what}: {' '.join(words)[:60]!r} ({error})") from error
    return from_polygons(np.array(vertices, np.float64).reshape(-1, 3), np.array(sizes), np.array(corners))


def read_off(data: bytes) -> Surface:
    """Read an Object File Format; colours, normals and texture coordinates say nothing.

    Raises:
        ValueError: it is not one, is binary or four-dimensional, or is cut short.
    """
    lines = [words for _, words in _lines(data)]
    head = lines[0][0] if lines else ""
    kind, glued, rest = head.partition("OFF")
    if not glued or set(kind) - set("STCN") or "BINARY" in lines[0]:
        raise ValueError(f"starts with {head[:20]!r}; allowed are text files that start with OFF, COFF, NOFF or STOFF")
    lines[0] = [word for word in (rest, *lines[0][1:]) if word]
    lines = [words for words in lines if words]
    num_vertices, num_faces = (int(word) for word in lines[0][:2])
    rows, faces = lines[1 : 1 + num_vertices], lines[1 + num_vertices : 1 + num_vertices + num_faces]
    if len(faces) < num_faces:
        raise ValueError(f"cut short: {num_vertices} vertices and {num_faces} faces are announced")
    sizes = np.array([int(words[0]) for words in faces], int)
    corners = [int(word) for words, size in zip(faces, sizes, strict=True) for word in words[1 : 1 + size]]
    if len(corners) != sizes.sum():
        raise ValueError("a face has fewer corners than it announces")
    return from_polygons(
        np.array([[float(w) for w in words[:3]] for words in rows]).reshape(-1, 3), sizes, np.array(corners)
    )


def _corner(word: str, count: int) -> int:
    """Return the vertex of a face's corner `v/vt/vn` after `count` vertices: from 1, or backwards from -1."""
    index = int(word.partition("/")[0])
    if not 1 <= abs(index) <= count and index < 1:
        raise ValueError(f"vertex {index} after {count} vertices")
    return index - 1 if index > 0 else count + index


def _lines(data: bytes, *, joined: bool = False) -> Iterator[tuple[int, list[str]]]:
    """Yield number and words of every line that is neither empty nor a comment; a backslash may join two."""
    text = _COMMENT.sub("", decode(data).replace("\r\n", "\n").replace("\r", "\n"))
    if joined:
        text = text.replace("\\\n", " ")
    for number, line in enumerate(text.split("\n"), 1):
        if words := line.split():
            yield number, words
