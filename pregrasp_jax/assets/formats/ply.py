"""The PLY format, text and binary, with polygons and triangle strips."""

from typing import NamedTuple

import numpy as np

from pregrasp_jax.assets.formats.surface import Surface, from_polygons, from_strips
from pregrasp_jax.assets.formats.text import decode

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"},
    **{"double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float32": "f4", "float64": "f8", "int64": "i8", "uint64": "u8"},
}

_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


class _Property(NamedTuple):
    """One column of an element: its name, the type of its values, and that of their count if it is a list."""

    name: str
    type: str
    count_type: str | None


class _Element(NamedTuple):
    """One table of the file."""

    name: str
    num_rows: int
    properties: list[_Property]


class _Rows(NamedTuple):
    """One column as read: values [sum of sizes] and sizes [rows]."""

    values: np.ndarray
    sizes: np.ndarray


_NOTHING = _Rows(np.zeros(0, int), np.zeros(0, int))


def read_ply(data: bytes) -> Surface:
    """Read vertices and faces or triangle strips; colours and normals say nothing.

    Raises:
        ValueError: the header is none, or the data is cut short.
    """
    if data.startswith(b"ply\rformat ascii"):
        data = data.replace(b"\r", b"\n")
    order, elements, body = _read_header(data)
    columns: dict[str, dict[str, _Rows]] = {}
    words = iter(decode(body).split()) if order == "" else None
    for element in elements:
        try:
            if words is not None:
                columns[element.name] = _read_text(element, words)
            else:
                columns[element.name], body = _read_binary(element, body, order)
        except (StopIteration, RuntimeError, IndexError) as error:
            raise ValueError(f"cut short: {element.num_rows} rows of element '{element.name}' are announced") from error
    vertex = columns.get("vertex", {})
    if not {"x", "y", "z"} <= vertex.keys():
        raise ValueError("has no element 'vertex' with x, y and z")
    vertices = np.column_stack([vertex[axis].values.astype(np.float64) for axis in "xyz"])
    faces, strips = (_indices(columns[name]) if name in columns else _NOTHING for name in ("face", "tristrips"))
    if len(strips.sizes) and len(faces.sizes):
        raise ValueError("has faces and triangle strips; allowed is one of them")
    if len(strips.sizes):
        return from_strips(vertices, _split_strips(strips))
    return from_polygons(vertices, faces.sizes, faces.values)


def _read_header(data: bytes) -> tuple[str, list[_Element], bytes]:
    """Return byte order (empty for text), elements, and the data after the header."""
    order, elements = None, []
    while data:
        line, _, data = data.partition(b"\n")
        words = decode(line).split()
        match words:
            case ["format", kind, *_] if kind in _ORDERS:
                order = _ORDERS[kind]
            case ["element", name, count]:
                elements.append(_Element(name, int(count), []))
            case ["property", "list", count_type, kind, name] if {count_type, kind} <= _TYPES.keys() and elements:
                elements[-1].properties.append(_Property(name, _TYPES[kind], _TYPES[count_type]))
            case ["property", kind, name] if kind in _TYPES and elements:
                elements[-1].properties.append(_Property(name, _TYPES[kind], None))
            case ["end_header"] if order is not None:
                return order, elements, data
            case ["ply"] | ["comment", *_] | ["obj_info", *_] | []:
                pass
            case _:
                raise ValueError(f"header line {' '.join(words)[:60]!r} is not known")
    raise ValueError("the header has no end")


def _indices(columns: dict[str, _Rows]) -> _Rows:
    for name in ("vertex_indices", "vertex_index"):
        if name in columns:
            return columns[name]
    raise ValueError(f"faces have {', '.join(columns) or 'nothing'}; wanted is a list vertex_indices")


def _split_strips(rows: _Rows) -> list[np.ndarray]:
    """Return the strips of all rows; -1 begins another one within a row."""
    strips = []
    for row in np.split(rows.values.astype(int), np.cumsum(rows.sizes)[:-1]):
        strips += [part[part >= 0] for part in np.split(row, np.flatnonzero(row < 0))]
    return strips


def _read_text(element: _Element, words) -> dict[str, _Rows]:
    """Read the rows of one element from an iterator of words."""
    columns: list[tuple[list[str], list[int]]] = [([], []) for _ in element.properties]
    for _ in range(element.num_rows):
        for item, (values, sizes) in zip(element.properties, columns, strict=True):
            size = 1 if item.count_type is None else int(next(words))
            values += [next(words) for _ in range(size)]
            sizes.append(size)
    return {
        item.name: _Rows(np.array(values, np.float64).astype(item.type), np.array(sizes, int))
        for item, (values, sizes) in zip(element.properties, columns, strict=True)
    }


def _read_binary(element: _Element, data: bytes, order: str) -> tuple[dict[str, _Rows], bytes]:
    """Read the rows of one element, and return the rest: at once if all lists are as long as in the first row."""
    if not element.num_rows:
        return {item.name: _Rows(np.zeros(0, item.type), np.zeros(0, int)) for item in element.properties}, data
    sizes, _ = _list_sizes(element, data, 0, order)
    fields = []
    for item, size in zip(element.properties, sizes, strict=True):
        if item.count_type is not None:
            fields.append((f"{item.name} count", order + item.count_type))
        fields.append((item.name, order + item.type, (size,)))
    row = np.dtype(fields)
    if row.itemsize * element.num_rows <= len(data):
        rows = np.frombuffer(data, row, element.num_rows)
        lists = [(i, s) for i, s in zip(element.properties, sizes, strict=True) if i.count_type is not None]
        if all((rows[f"{item.name} count"] == size).all() for item, size in lists):
            columns = {
                item.name: _Rows(rows[item.name].ravel(), np.full(element.num_rows, size))
                for item, size in zip(element.properties, sizes, strict=True)
            }
            return columns, data[row.itemsize * element.num_rows :]
    return _read_binary_slowly(element, data, order)


def _read_binary_slowly(element: _Element, data: bytes, order: str) -> tuple[dict[str, _Rows], bytes]:
    """Read rows whose lists differ in length, one by one."""
    parts: list[tuple[list[np.ndarray], list[int]]] = [([], []) for _ in element.properties]
    start = 0
    for _ in range(element.num_rows):
        sizes, end = _list_sizes(element, data, start, order)
        for item, size, (values, counts) in zip(element.properties, sizes, parts, strict=True):
            start += 0 if item.count_type is None else np.dtype(item.count_type).itemsize
            values.append(np.frombuffer(data, order + item.type, size, start))
            counts.append(size)
            start += size * np.dtype(item.type).itemsize
        start = end
    columns = {
        item.name: _Rows(np.concatenate(values), np.array(counts, int))
        for item, (values, counts) in zip(element.properties, parts, strict=True)
    }
    return columns, data[start:]


def _list_sizes(element: _Element, data: bytes, start: int, order: str) -> tuple[list[int], int]:
    """Return how many values every property of the row at `start` has, and where the row ends."""
    sizes = []
    for item in element.properties:
        size = 1
        if item.count_type is not None:
            kind = np.dtype(order + item.count_type)
            if start + kind.itemsize > len(data):
                raise IndexError
            size = int(np.frombuffer(data, kind, 1, start)[0])
            start += kind.itemsize
        sizes.append(size)
        start += size * np.dtype(item.type).itemsize
    if start > len(data) or min(sizes, default=0) < 0:
        raise IndexError
    return sizes, start
