"""Meshes from files of any format that trimesh reads; what is missing, damaged or cut short is named."""

import os
import re
import struct
import zipfile
from pathlib import Path

import numpy as np
import trimesh

from jaxnbv.checks import InputError, checked, require, shown
from jaxnbv.scanning.mesh import TriangleMesh

# In bytes: what a header of PLY or OFF is shorter than, and what an archive may unpack to.
_HEADER, _LARGEST = 2**16, 2**29
_AGAIN = "fetch or export it again"


@checked
def load_mesh(path: str | Path, up: str = "y") -> TriangleMesh:
    """The mesh in a file of any format that trimesh reads; a scene's geometries are joined where it places them.

    - `up`: the file's axis that is upward, see `Frame`.

    **Raises:** `ValueError` if the file is missing or cannot be read, and as `TriangleMesh.from_arrays` does.
    """
    return joined_nodes(path, [mesh for _, mesh in read_nodes(path)], up)


def joined_nodes(path: str | Path, meshes: list[trimesh.Trimesh], up: str) -> TriangleMesh:
    """The mesh that the nodes of a file make together.

    **Raises:** `ValueError` as `TriangleMesh.from_arrays` does, for the file.
    """
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    vertices = np.concatenate([mesh.vertices for mesh in meshes])
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)])
    try:
        return TriangleMesh.from_arrays(vertices, faces, up)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def read_nodes(path: str | Path) -> list[tuple[str, trimesh.Trimesh]]:
    """The nodes of a file that have faces, by name, where its scene places them, in the file's coordinates.

    **Raises:** `ValueError` if the file is missing, cannot be read, or has no faces.
    """
    path = Path(path)
    require(os.path.isfile(path), f"no mesh file at {shown(str(path))}: check the path")
    try:
        if zipfile.is_zipfile(path):
            size = sum(member.file_size for member in zipfile.ZipFile(path).infolist())
            require(size <= _LARGEST, f"{path} unpacks to {size} bytes: unpack it, and give the mesh")
        parts = trimesh.load_scene(path, path.suffix[1:].lower(), process=False).dump()
    except InputError:
        raise
    except Exception as error:  # Each of trimesh's readers fails in its own way.
        problem = f"cannot read {path} as a mesh ({type(error).__name__}: {error})"
        raise InputError(f"{problem}: {_why_unread(path)}") from error
    meshes = [part for part in parts if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    require(len(meshes) > 0, f"{path} has no faces: {_why_empty(path)}")
    found = sum(len(mesh.vertices) for mesh in meshes), sum(len(mesh.faces) for mesh in meshes)
    for what, count, declared in zip(("vertices", "faces"), found, _declared(path), strict=True):
        require(count >= declared, f"{path} has {count} of the {declared} {what} that its header declares: {_AGAIN}")
    return [(str(mesh.metadata.get("node", index)), mesh) for index, mesh in enumerate(meshes)]


def _declared(path: Path) -> tuple[int, int]:
    """How many vertices and faces the header of a PLY or OFF file declares; trimesh takes one that ends early."""
    with path.open("rb") as file:
        head = file.read(_HEADER).decode("latin1")
    if path.suffix.lower() == ".off":
        found = re.match(r"\s*[A-Z]*OFF\s*(\d+)\s+(\d+)", re.sub(r"#.*", "", head))
        counts = [int(count) for count in found.groups()] if found else []
    elif path.suffix.lower() == ".ply":
        elements = dict(re.findall(r"(?m)^element (\w+) (\d+)\s*$", head.partition("end_header")[0]))
        counts = [int(elements.get(name, 0)) for name in ("vertex", "face")]
    else:
        counts = []
    return (counts[0], counts[1]) if len(counts) == 2 else (0, 0)


def _why_unread(path: Path) -> str:
    if path.open("rb").read(3) == b"\xef\xbb\xbf":
        return "it begins with a byte-order mark; save it as UTF-8 without one"
    formats = sorted(trimesh.available_formats())
    if path.suffix.lower().removeprefix(".") in formats:
        return "it is damaged, or not what its name says; export it again"
    return f"it must be one of {', '.join(formats)}, some of which need a package of their own"


def _why_empty(path: Path) -> str:
    """A binary STL that is cut short reads as an empty one."""
    if path.suffix.lower() == ".stl":
        head, length = path.open("rb").read(84), path.stat().st_size
        count = struct.unpack("<I", head[80:84])[0] if len(head) == 84 else 0
        if not head.startswith(b"solid") and length != 84 + 50 * count:
            return f"it has {length} bytes where a binary STL of {count} faces has {84 + 50 * count}; fetch it again"
    return "a point cloud or an empty file cannot be scanned"
