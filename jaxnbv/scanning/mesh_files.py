"""Readers of meshes, and of the parts of a mesh, from files in any format that trimesh reads."""

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
    """Load a mesh from a file in any format that trimesh reads, or convert a trimesh mesh or scene.

    If the file or scene has several geometries, their transforms are applied and they are joined into one mesh.

    - `up`: the file's axis that is upward, see `Frame`.

    **Raises:** `ValueError` if the file is missing, cannot be read, or has features that the reader would ignore (such
    as a skeleton or sparse accessors in glTF), or for the same reasons as `TriangleMesh.from_arrays`.
    """
    return joined_nodes(path, [mesh for _, mesh in read_nodes(path)], up)


def as_surface(scene: Surface | SignedDistance | trimesh.Trimesh | trimesh.Scene) -> Surface:
    """Convert a scene of any accepted type to a surface.

    A solid becomes an `SDFSurface`, and a trimesh object is converted by `load_mesh` with the y axis up.

    **Raises:** `ValueError` for the same reasons as `load_mesh`.
    """
    if isinstance(scene, trimesh.Trimesh | trimesh.Scene):
        return load_mesh(scene)
    return SDFSurface(scene) if isinstance(scene, SignedDistance) else scene


class MeshParts(eqx.Module):
    """A mesh and its parts, from a file that has a node for each part.

    - `parts`: each part as a mesh, in the scene coordinates of the whole mesh.
    - `names`: name of each part's node in the file.
    """

    mesh: TriangleMesh
    parts: tuple[TriangleMesh, ...]
    names: tuple[str, ...] = eqx.field(static=True)

    def distances(self, grid: Grid) -> Float[Array, "parts g g g"]:
        """Return the unsigned distance from each node of a grid to the surface of each part, in scene units."""
        nodes = np.stack(np.meshgrid(*[grid.axis] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        distances = [distance_to_triangles(nodes, part.vertices, part.faces) for part in self.parts]
        shape = len(self.parts), *(grid.resolution,) * 3
        return jnp.asarray(np.stack(distances).reshape(shape), jnp.result_type(float))


def load_parts(path: str | Path | trimesh.Scene, up: str = "y") -> MeshParts:
    """Load a mesh and its parts from a file or a trimesh scene.

    Each node that has a face of positive area is a part. Parts are sorted by the names of their nodes.

    - `up`: the file's axis that is upward, see `Frame`.

    **Raises:** `ValueError` for the same reasons as `load_mesh`, or if there is only one part.
    """
    nodes = read_nodes(path)
    mesh = joined_nodes(path, [node for _, node in nodes], up)
    parts = [
        (name, TriangleMesh(mesh.frame.to_scene(node.vertices), node.faces[node.area_faces > 0], mesh.frame))
        for name, node in sorted(nodes, key=lambda node: node[0])
        if (node.area_faces > 0).any()
    ]
    require(len(parts) > 1, f"{path} has one node, and so no parts: save each part as a node of its own")
    return MeshParts(mesh, tuple(part for _, part in parts), tuple(name for name, _ in parts))


def joined_nodes(path: str | Path | trimesh.Geometry, meshes: list[trimesh.Trimesh], up: str) -> TriangleMesh:
    """Join the meshes of all nodes of a file into one.

    **Raises:** `ValueError` for the same reasons as `TriangleMesh.from_arrays`, with the path in the message.
    """
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    vertices = np.concatenate([mesh.vertices for mesh in meshes])
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)])
    try:
        return TriangleMesh.from_arrays(vertices, faces, up)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def read_nodes(path: str | Path | trimesh.Geometry) -> list[tuple[str, trimesh.Trimesh]]:
    """Return the name and the mesh of each node that has faces, in the coordinates of the file or scene.

    **Raises:** `ValueError` for a file that is missing, unreadable, without faces, or with unsupported features.
    """
    meshes = _read_file(Path(path)) if isinstance(path, str | Path) else _named_meshes(path)
    meshes = [(name, mesh) for name, mesh in meshes if len(mesh.faces)]
    require(len(meshes) > 0, f"{path} has no faces: it is a point cloud, empty, or an STL that was cut short")
    return meshes


def _read_file(path: Path) -> list[tuple[str, trimesh.Trimesh]]:
    require(os.path.isfile(path), f"no mesh file at {short_text(str(path))}: check the path")
    try:
        return _read(path)
    except InputError as error:
        raise InputError(f"cannot read {path}: it {error}") from error
    except Exception as error:  # Each of trimesh's readers raises errors of its own types.
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
        return _named_meshes(read_gltf(content, kind, resolver))
    return _named_meshes(trimesh.load_scene(BytesIO(content), kind, resolver, process=False))


def _named_meshes(geometry: trimesh.Geometry) -> list[tuple[str, trimesh.Trimesh]]:
    """Return the name of each mesh's node (or an index), and the mesh in the scene's coordinates."""
    parts = geometry.dump() if isinstance(geometry, trimesh.Scene) else [geometry]
    meshes = [part for part in parts if isinstance(part, trimesh.Trimesh)]
    return [(str(mesh.metadata.get("node", index)), mesh) for index, mesh in enumerate(meshes)]
