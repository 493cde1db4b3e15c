"""Meshes and their parts from files of any format that trimesh reads."""

import os
from io import BytesIO
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Array, Float

from jaxnbv.checks import InputError, checked, require, short_text
from jaxnbv.scanning.gltf import read_gltf
from jaxnbv.scanning.grid import Grid
from jaxnbv.scanning.mesh import TriangleMesh
from jaxnbv.scanning.mesh_rows import read_obj, read_off, without_mark
from jaxnbv.scanning.ply_rows import read_ply
from jaxnbv.scanning.scanner import Surface
from jaxnbv.scanning.sdf import SignedDistance
from jaxnbv.scanning.sdf.sampled import distance_to_triangles
from jaxnbv.scanning.sphere_tracing import SDFSurface


@checked
def load_mesh(path: str | Path | trimesh.Trimesh | trimesh.Scene, up: str = "y") -> TriangleMesh:
    """The mesh in a file of any format that trimesh reads, or of a trimesh mesh or scene.

    The geometries of a scene are joined where it places them.

    - `up`: the file's axis that is upward, see `Frame`.

    **Raises:** `ValueError` if the file is missing, cannot be read, or has features that the reader would ignore (such
    as a skeleton or sparse accessors in glTF), and as `TriangleMesh.from_arrays` does.
    """
    return joined_nodes(path, [mesh for _, mesh in read_nodes(path)], up)


def as_surface(scene: Surface | SignedDistance | trimesh.Trimesh | trimesh.Scene) -> Surface:
    """The surface of a scene: itself, the boundary of a solid, or a trimesh object by `load_mesh` (y up).

    **Raises:** `ValueError` as `load_mesh` does.
    """
    if isinstance(scene, trimesh.Trimesh | trimesh.Scene):
        return load_mesh(scene)
    return SDFSurface(scene) if isinstance(scene, SignedDistance) else scene


class MeshParts(eqx.Module):
    """A mesh whose file has a node for each part.

    - `mesh`: the whole mesh.
    - `parts`: the triangles of each part, in the scene coordinates of the whole.
    - `names`: name of each part's node.
    """

    mesh: TriangleMesh
    parts: tuple[TriangleMesh, ...]
    names: tuple[str, ...] = eqx.field(static=True)

    def distances(self, grid: Grid) -> Float[Array, "parts g g g"]:
        """Unsigned distance from each of the grid's nodes to the surface of each part, in scene units."""
        nodes = np.stack(np.meshgrid(*[grid.axis] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        distances = [distance_to_triangles(nodes, part.vertices, part.faces) for part in self.parts]
        shape = len(self.parts), *(grid.resolution,) * 3
        return jnp.asarray(np.stack(distances).reshape(shape), jnp.result_type(float))


def load_parts(path: str | Path | trimesh.Scene, up: str = "y") -> MeshParts:
    """The mesh in a file or trimesh scene and its parts.

    There is one part for each node with a face of positive area, sorted by name.

    - `up`: the file's axis that is upward, see `Frame`.

    **Raises:** `ValueError` as `load_mesh` does, or if there is only one part.
    """
    nodes = read_nodes(path)
    mesh = joined_nodes(path, [node for _, node in nodes], up)
    solid = [(name, node, node.faces[node.area_faces > 0]) for name, node in sorted(nodes, key=lambda node: node[0])]
    whole = [(name, node, faces) for name, node, faces in solid if len(faces)]
    require(len(whole) > 1, f"{path} has one node, and so no parts: save each part as a node of its own")
    parts = tuple(TriangleMesh(mesh.frame.to_scene(node.vertices), faces, mesh.frame) for _, node, faces in whole)
    return MeshParts(mesh, parts, tuple(name for name, *_ in whole))


def joined_nodes(path: str | Path | trimesh.Geometry, meshes: list[trimesh.Trimesh], up: str) -> TriangleMesh:
    """The single mesh of all nodes of a file.

    **Raises:** `ValueError` as `TriangleMesh.from_arrays` does, with the path in the message.
    """
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    vertices = np.concatenate([mesh.vertices for mesh in meshes])
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)])
    try:
        return TriangleMesh.from_arrays(vertices, faces, up)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def read_nodes(path: str | Path | trimesh.Geometry) -> list[tuple[str, trimesh.Trimesh]]:
    """Name and placed mesh of each node with faces in a file or scene, in the file's coordinates.

    **Raises:** `ValueError` if the file is missing, cannot be read, has no faces, or has features that its reader would
    ignore.
    """
    meshes = _read_file(Path(path)) if isinstance(path, str | Path) else _placed(path)
    meshes = [(name, mesh) for name, mesh in meshes if len(mesh.faces)]
    require(len(meshes) > 0, f"{path} has no faces: it is a point cloud, empty, or an STL that was cut short")
    return meshes


def _read_file(path: Path) -> list[tuple[str, trimesh.Trimesh]]:
    require(os.path.isfile(path), f"no mesh file at {short_text(str(path))}: check the path")
    try:
        return _read(path)
    except InputError as error:
        raise InputError(f"cannot read {path}: it {error}") from error
    except Exception as error:  # Each of trimesh's readers fails in its own way.
        formats = ", ".join(sorted(trimesh.available_formats()))
        raise InputError(
            f"cannot read {path} as a mesh ({type(error).__name__}: {error}): it is damaged, or none of {formats}, "
            "some of which need a package of their own"
        ) from error


def _read(path: Path) -> list[tuple[str, trimesh.Trimesh]]:
    kind, content = path.suffix[1:].lower(), without_mark(path.read_bytes())
    if kind in ("obj", "off", "ply"):
        rows = read_obj(content) if kind == "obj" else {"mesh": (read_off if kind == "off" else read_ply)(content)}
        return [(name, trimesh.Trimesh(vertices, faces, process=False)) for name, (vertices, faces) in rows.items()]
    resolver = trimesh.resolvers.FilePathResolver(str(path))
    if kind in ("glb", "gltf"):
        return _placed(read_gltf(content, kind, resolver))
    return _placed(trimesh.load_scene(BytesIO(content), kind, resolver, process=False))


def _placed(geometry: trimesh.Geometry) -> list[tuple[str, trimesh.Trimesh]]:
    """Name of the node and placed mesh, for each mesh of a scene or for a single mesh."""
    parts = geometry.dump() if isinstance(geometry, trimesh.Scene) else [geometry]
    meshes = [part for part in parts if isinstance(part, trimesh.Trimesh)]
    return [(str(mesh.metadata.get("node", index)), mesh) for index, mesh in enumerate(meshes)]
