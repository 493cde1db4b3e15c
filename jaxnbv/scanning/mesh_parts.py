"""A mesh and its parts: those nodes that a file is made of."""

from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxnbv.checks import require
from jaxnbv.scanning.grid import Grid
from jaxnbv.scanning.mesh import TriangleMesh
from jaxnbv.scanning.mesh_files import joined_nodes, read_nodes
from jaxnbv.scanning.triangles import distance_to_triangles


class MeshParts(eqx.Module):
    """A mesh whose file has a node for each part.

    - `mesh`: the whole.
    - `parts`: the triangles of each, in the scene coordinates of the whole; `names`: those of the nodes.
    """

    mesh: TriangleMesh
    parts: tuple[TriangleMesh, ...]
    names: tuple[str, ...] = eqx.field(static=True)

    def distances(self, grid: Grid) -> Float[Array, "parts g g g"]:
        """From the grid's nodes to the surface of each part, in scene units."""
        nodes = np.stack(np.meshgrid(*[grid.axis] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        found = [distance_to_triangles(nodes, part.vertices, part.faces) for part in self.parts]
        shape = len(self.parts), *(grid.resolution,) * 3
        return jnp.asarray(np.stack(found).reshape(shape), jnp.result_type(float))


def load_parts(path: str | Path, up: str = "y") -> MeshParts:
    """The mesh in a file and its parts, one for each node that has a face of positive area, in the order of names.

    - `up`: the file's axis that is upward, see `Frame`.

    **Raises:** `ValueError` as `load_mesh` does, or if there is one part alone.
    """
    nodes = read_nodes(path)
    mesh = joined_nodes(path, [node for _, node in nodes], up)
    solid = [(name, node, node.faces[node.area_faces > 0]) for name, node in sorted(nodes, key=lambda node: node[0])]
    whole = [(name, node, faces) for name, node, faces in solid if len(faces)]
    require(len(whole) > 1, f"{path} has one node: a file has parts if each of them is a node")
    parts = tuple(TriangleMesh(mesh.frame.to_scene(node.vertices), faces, mesh.frame) for _, node, faces in whole)
    return MeshParts(mesh, parts, tuple(name for name, *_ in whole))
