"""Reader of vertices and faces from PLY files of any encoding."""

import re
from collections.abc import Iterable
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Int

from jaxnbv.checks import require
from jaxnbv.scanning.mesh_rows import Triangles, as_array, cut_short, triangles_of

_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
_TYPES |= {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
_TYPES |= {"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"}
# Byte order of each encoding. Text is first converted to little-endian 64-bit numbers.
_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
# Name and type of a property. For a list, the third entry is the type of the list's length, otherwise None.
_Property: TypeAlias = tuple[str, np.dtype, np.dtype | None]


def read_ply(content: bytes) -> Triangles:
    """Read the triangles of a PLY file: its faces, which are cut into fans, and its triangle strips.

    **Raises:** `ValueError` for an invalid header, missing rows, or entries that are not numbers.
    """
    head = re.match(rb"ply\s.*?[\r\n]end_header[ \t]*(\r\n|\n|\r)", content, re.DOTALL)
    encoding, elements = _header(head.group().decode("latin1") if head else "")
    body = content[head.end() if head else 0 :]
    if encoding == "ascii":
        body = as_array([body.decode("latin1").split()]).astype("<f8").tobytes()
    columns: dict[str, dict[str, Any]] = {}
    start = 0
    for name, (count, properties) in elements.items():
        columns[name], start = _element(body, start, name, count, properties)
    points, faces, strips = (columns.get(name, {}) for name in ("vertex", "face", "tristrips"))
    require({"x", "y", "z"} <= set(points), "has no vertices with x, y and z")
    corners = [rows for name, rows in faces.items() if name in ("vertex_indices", "vertex_index")]
    pieces = [triangles_of(rows) for rows in corners] + [_strip_triangles(rows) for rows in strips.values()]
    vertices = np.stack([np.asarray(points[axis], np.float64).ravel() for axis in "xyz"], axis=1)
    return vertices, np.concatenate([np.zeros((0, 3), np.int64), *pieces])


def _header(text: str) -> tuple[str, dict[str, tuple[int, list[_Property]]]]:
    """Return the encoding of a PLY file, and the row count and properties of each element, keyed by name."""
    encoding, elements = "", dict[str, tuple[int, list[_Property]]]()

    def kind_of(word: str) -> np.dtype:
        require(word in _TYPES, f"has values of type {word!r}, which PLY does not define: save it again")
        return np.dtype("<f8" if encoding == "ascii" else _ORDERS[encoding] + _TYPES[word])

    for line in re.split("[\\r\\n]+", text):
        words = line.split()
        if words[:1] == ["format"]:
            encoding = words[1]
            require(encoding in _ORDERS, f"is a PLY file with encoding {encoding!r}: save it as binary or ASCII")
        elif words[:1] == ["element"]:
            elements[words[1]] = int(words[2]), []
        elif words[:1] == ["property"]:
            length = kind_of(words[2]) if words[1] == "list" else None
            elements[next(reversed(elements))][1].append((words[-1], kind_of(words[-2]), length))
    require(encoding != "", "has no PLY header")
    return encoding, elements


def _element(
    body: bytes, start: int, element: str, count: int, properties: list[_Property]
) -> tuple[dict[str, Any], int]:
    """Read the `count` rows of an element from byte `start` on.

    Return its columns, keyed by property name, and the byte at which it ends. A column of lists is an array if all
    lists have the same length, else a list with one array per row.
    """
    if count == 0:
        return {name: [] for name, *_ in properties}, start
    what = f"{element!r} elements"
    first, end = _row(body, start, properties, cut_short(0, count, what))
    fields: list[Any] = []
    for (name, kind, length), values in zip(properties, first, strict=True):
        fields += [(name, kind)] if length is None else [(f"length of {name}", length), (name, kind, (len(values),))]
    row_type = np.dtype(fields)
    if start + count * row_type.itemsize <= len(body):
        rows = np.frombuffer(body, row_type, count, start)
        sizes = [(rows[f"length of {name}"], rows[name].shape[1]) for name, _, length in properties if length]
        if all((lengths == size).all() for lengths, size in sizes):
            return {name: rows[name] for name, *_ in properties}, start + rows.nbytes
    columns = [[values] for values in first]
    for index in range(1, count):
        row, end = _row(body, end, properties, cut_short(index, count, what))
        for column, values in zip(columns, row, strict=True):
            column.append(values)
    return {name: column for (name, *_), column in zip(properties, columns, strict=True)}, end


def _row(body: bytes, start: int, properties: list[_Property], message: str) -> tuple[list[np.ndarray], int]:
    """Return the row that begins at byte `start`, and the byte at which it ends.

    **Raises:** `ValueError` with `message` if `body` ends within the row.
    """
    row: list[np.ndarray] = []
    for _, kind, length in properties:
        parts = [(kind, 1)] if length is None else [(length, 1), (kind, -1)]
        for part, size in parts:
            size = int(row.pop()[0]) if size < 0 else size
            end = start + size * part.itemsize
            require(start <= end <= len(body), message)
            row.append(np.frombuffer(body, part, size, start) if size else np.zeros(0, part))
            start = end
    return row, start


def _strip_triangles(strips: Iterable[np.ndarray]) -> Int[np.ndarray, "f 3"]:
    """Convert triangle strips to triangles. Each row of vertex indices holds strips with -1 between them.

    Every second triangle of a strip is reversed, so that all triangles have the same winding.
    """
    faces = [np.zeros((0, 3), np.int64)]
    for strip in strips:
        indices = np.asarray(strip, np.int64)
        for piece in np.split(indices, np.flatnonzero(indices < 0)):
            corners = piece[piece >= 0]
            rows = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
            rows[1::2] = rows[1::2, ::-1]
            faces.append(rows)
    return np.concatenate(faces)
