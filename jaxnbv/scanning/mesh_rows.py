"""Readers of vertices and faces from text formats: OBJ and OFF."""

import codecs
import io
import re
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from jaxtyping import Float, Int

from jaxnbv.checks import InputError, require

Triangles: TypeAlias = tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]

# Longer byte order marks come first, since the mark of UTF-32 begins with the mark of UTF-16.
_MARKS = (
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
    (codecs.BOM_UTF8, "utf-8-sig"),
)


def without_mark(content: bytes) -> bytes:
    """Convert text with a byte order mark to UTF-8 without the mark. Return all other bytes unchanged."""
    for mark, encoding in _MARKS:
        if content.startswith(mark):
            return content.decode(encoding, "replace").encode()
    return content


def read_obj(content: bytes) -> dict[str, Triangles]:
    """Read the triangles of an OBJ file, keyed by material name. Polygons are cut into triangle fans.

    **Raises:** `ValueError` for a vertex or a face that is not a row of numbers.
    """
    vertices: list[list[str]] = []
    polygons: dict[str, list[list[int]]] = {}
    material = ""
    text = content.decode("utf-8", "replace").replace("\r\n", "\n").replace("\\\n", " ")
    for line in io.StringIO(text, newline=None):
        word, *values = line.partition("#")[0].split() or [""]
        if word == "v":
            vertices.append(values[:3])
        elif word == "usemtl":
            material = " ".join(values)
        elif word == "f":
            try:
                corners = [int(value.partition("/")[0]) for value in values]
            except ValueError as error:
                raise InputError(f"has a face {line.strip()!r}, whose corners are not vertex numbers") from error
            # Negative numbers count back from the latest vertex. Zero is invalid: it becomes -1, which is rejected.
            rows = [corner - 1 if corner > 0 else len(vertices) + corner if corner else -1 for corner in corners]
            polygons.setdefault(material, []).append(rows)
    points = as_array(vertices)
    parts = {name: triangles_of(group) for name, group in polygons.items()}
    if len(parts) > 1:
        return {name: _drop_unused(points, faces) for name, faces in parts.items()}
    return {name: (points, faces) for name, faces in parts.items()}


def read_off(content: bytes) -> Triangles:
    """Read the triangles of a text OFF file. Colours, normals and texture coordinates are ignored.

    **Raises:** `ValueError` for an OFF file that is binary or does not have three coordinates per vertex, for missing
    rows, or for entries that are not numbers.
    """
    text = re.sub("#.*", "", content.decode("utf-8", "replace"))
    head = re.match(r"\s*(ST)?C?N?OFF\b\s*|\s*(ST)?C?N?OFF(?=\d)", text)
    require(
        head is not None and not text[head.end() :].startswith("BINARY"),
        "is not a text OFF file with three coordinates per vertex: save it as PLY",
    )
    rows = [line.split() for line in text[head.end() if head else 0 :].splitlines() if line.strip()]
    require(bool(rows) and len(rows[0]) >= 2 and "".join(rows[0][:2]).isdigit(), "declares no vertex and face counts")
    num_vertices, num_faces = int(rows[0][0]), int(rows[0][1])
    points, polygons = rows[1 : num_vertices + 1], rows[num_vertices + 1 : num_vertices + num_faces + 1]
    for rows, count, what in ((points, num_vertices, "vertices"), (polygons, num_faces, "faces")):
        require(len(rows) == count, cut_short(len(rows), count, what))
    corners = []
    for row in polygons:
        words = row[1 : int(row[0]) + 1] if row[0].isdigit() else []
        is_valid = row[0] == str(len(words)) and all(word.isdigit() for word in words)
        require(is_valid, f"has a face {' '.join(row)!r}, which is not a number of corners and their vertices")
        corners.append([int(word) for word in words])
    return as_array([row[:3] for row in points]), triangles_of(corners)


def triangles_of(polygons: Sequence[Sequence[int]] | Sequence[np.ndarray] | np.ndarray) -> Int[np.ndarray, "f 3"]:
    """Cut each polygon, a row of vertex indices, into a fan of triangles. Two corners or fewer give none."""
    if isinstance(polygons, np.ndarray):
        groups = [polygons]
    else:
        sizes = sorted({len(polygon) for polygon in polygons})
        groups = [np.array([polygon for polygon in polygons if len(polygon) == size]) for size in sizes]
    fans = [np.zeros((0, 3), np.int64)]
    for corners in groups:
        fans += [corners[:, [0, middle, middle + 1]].astype(np.int64) for middle in range(1, corners.shape[1] - 1)]
    return np.concatenate(fans)


def _drop_unused(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Triangles:
    """Drop the vertices that no triangle uses. If an index is out of range, return all unchanged."""
    if not len(faces) or faces.min() < 0 or faces.max() >= len(vertices):
        return vertices, faces
    rows, faces = np.unique(faces, return_inverse=True)
    return vertices[rows], faces.reshape(-1, 3)


def as_array(rows: list[list[str]]) -> Float[np.ndarray, "n k"]:
    """Convert rows of words to an array of numbers.

    **Raises:** `ValueError` if rows differ in length or a word is not a number.
    """
    try:
        return np.array(rows, np.float64) if rows else np.zeros((0, 3))
    except ValueError as error:
        commas = any("," in word for row in rows for word in row)
        remedy = "write decimal points in place of commas" if commas else "it is damaged: fetch it again"
        raise InputError(f"has rows that are not numbers or differ in length ({error}): {remedy}") from error


def cut_short(count: int, declared: int, what: str) -> str:
    """Return the error message for a file that ends before all declared rows."""
    return f"has {count} of the {declared} {what} that its header declares: fetch it again"
