"""`TriangleMesh`: meshes of any quality, such as triangle soups and open sheets, traced by host code."""

import dataclasses
import warnings
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int, PRNGKeyArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from jaxnbv.checks import AnyArray, InputError, check_key, check_type, checked, is_traced, require
from jaxnbv.errors import optional
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.tensor_grid import on_tensor_grid
from jaxnbv.scanning.grid import Grid
from jaxnbv.scanning.scanner import Hits, Surface
from jaxnbv.scanning.sdf import SignedDistance
from jaxnbv.scanning.sdf.sampled import checked_triangles, is_inside
from jaxnbv.scanning.triangle_rays import FirstFaces, first_faces

# A connected component of a mesh that has fewer observed points nearby may come from stray points alone.
_MIN_POINTS = 4


@dataclasses.dataclass(unsafe_hash=True)
class _Tree:
    """Cache of the ray tracer for the triangles of the last call. A copy of the cache is empty.

    All instances compare equal, so that meshes, of which a `_Tree` is a static field, can differ only in their arrays.
    """

    _cache = None

    def get(self, vertices: np.ndarray, faces: np.ndarray) -> FirstFaces:
        cache = self._cache
        if cache is None or cache[0] is not vertices or cache[1] is not faces:
            cache = self._cache = vertices, faces, first_faces(vertices, faces)
        return cache[2]

    def __reduce__(self) -> tuple[type["_Tree"], tuple[()]]:
        return _Tree, ()


class TriangleMesh(Surface):
    """A mesh of triangles, which may be open, inconsistently wound or disconnected.

    Build a mesh with `load_mesh` or `from_arrays`, which check the triangles and fit the frame.

    - `vertices`: corners of the triangles in scene coordinates, a NumPy array of float64.
    - `faces`: three row indices into `vertices` for each triangle.
    - `frame`: the frame that maps the mesh's original world coordinates to the scene.

    Host code traces the rays, so `trace` cannot run under JAX transformations.
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    frame: Frame
    _tree: _Tree = eqx.field(static=True)
    in_jit: ClassVar[bool] = False

    def __init__(self, vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], frame: Frame | None = None):
        if frame is None:
            raise InputError(
                "a TriangleMesh needs the frame of its vertices: use TriangleMesh.from_arrays(vertices, faces)"
            )
        self.vertices = np.asarray(vertices, dtype=np.float64)
        self.faces = np.asarray(faces, dtype=np.int64)
        self.frame = frame
        self._tree = _Tree()

    @classmethod
    def from_arrays(
        cls, vertices: Float[AnyArray, "v 3"] | list, faces: Int[AnyArray, "f 3"] | list, up: str = "y"
    ) -> "TriangleMesh":
        """Build a mesh from vertices (world coordinates) and faces. Its longest side becomes 2.5 scene units.

        Vertices that no face uses are dropped. Faces of zero area are dropped with a `UserWarning`.

        - `up`: the world's axis that is upward, see `Frame`.

        **Raises:** `ValueError` if `vertices` or `faces` is not (n, 3), there are no faces, an index is not an integer
        or out of range, a vertex is not finite, or no face has a positive area.
        """
        vertices, faces = checked_triangles(vertices, faces)
        # Areas are compared with the squared size of the mesh, so that the unit of length does not matter.
        corners = vertices[faces]
        area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        has_area = area > 1e-14 * np.ptp(corners.reshape(-1, 3), axis=0).max() ** 2
        require(bool(has_area.any()), f"all {len(faces)} faces of the mesh have zero area: nothing can be scanned")
        if not has_area.all():
            warnings.warn(f"dropped {(~has_area).sum()} of {len(faces)} faces: they have zero area", stacklevel=2)
        rows, faces = np.unique(faces[has_area], return_inverse=True)
        frame = Frame.fit(np.asarray(vertices[rows]), up=up)
        return cls(frame.to_scene(vertices[rows]), faces.reshape(-1, 3), frame)

    def trace(self, origins: Float[AnyArray, "rays 3"], directions: Float[AnyArray, "rays 3"]) -> Hits:
        """Return the first hits of the rays, see `Surface.trace`. A hit lies in the plane of its triangle.

        **Raises:** `ValueError` under `jit`, `vmap` or `grad`.
        """
        require(
            not is_traced(self, origins, directions),
            "a TriangleMesh is scanned by host code and cannot be traced by JAX: scan it outside jit, vmap and grad, "
            "or trace SDFSurface(sdf.solid_of_mesh(mesh.vertices, mesh.faces)) instead, which runs inside",
        )
        origins, directions = (np.asarray(a, dtype=np.float64) for a in (origins, directions))
        rows, distances = self._tree.get(self.vertices, self.faces)(origins, directions)
        (hit_rays,) = np.nonzero(rows >= 0)
        origins, directions, tracer_distances = origins[hit_rays], directions[hit_rays], distances[hit_rays]
        a, b, c = np.moveaxis(self.vertices[self.faces[rows[hit_rays]]], 1, 0)
        normals = np.cross(b - a, c - a)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        cosine = np.sum(normals * directions, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = np.sum(normals * (a - origins), axis=1) / cosine
        # For a triangle seen edge-on, the intersection with its plane is ill-defined, so the tracer's distance is used.
        depth = np.where(np.abs(depth - tracer_distances) < 1e-3, depth, tracer_distances)
        mask = np.zeros(len(rows), dtype=bool)
        mask[hit_rays] = True
        points, outward = np.zeros((2, len(mask), 3))
        points[hit_rays] = origins + depth[:, None] * directions
        outward[hit_rays] = normals * np.where(cosine > 0, -1.0, 1.0)[:, None]
        dtype = jnp.result_type(float)
        return Hits(jnp.asarray(points, dtype), jnp.asarray(outward, dtype), jnp.asarray(mask))

    def sample_points(self, key: PRNGKeyArray, count: int) -> Float[np.ndarray, "count 3"]:
        """Draw `count` random points on the surface, uniform by area, in scene coordinates.

        **Raises:** `ValueError` if `count` < 1.
        """
        check_key(key)
        check_type(count, int, "the number of points")
        require(count >= 1, f"cannot sample {count} points; ask for at least one")
        rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
        points, _ = trimesh.sample.sample_surface(self.to_trimesh(), count, seed=rng)
        return np.asarray(points)

    @property
    def bounding_radius(self) -> float:
        """Distance from the scene's origin to the farthest vertex."""
        return float(np.linalg.norm(self.vertices, axis=1).max())

    @property
    def world_frame(self) -> Frame:
        return self.frame

    @checked
    def contains(self, points: Float[AnyArray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Return, for each point (scene coordinates), whether the mesh encloses it: |winding number| > 1/2."""
        return is_inside(np.asarray(points, dtype=np.float64), self.vertices, self.faces)

    def to_trimesh(self) -> trimesh.Trimesh:
        """Return the mesh in scene coordinates as a `trimesh.Trimesh`, to show, measure or export it."""
        return trimesh.Trimesh(self.vertices, self.faces, process=False)


def level_triangles(
    values: Float[np.ndarray, "g g g"], grid: Grid
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"], Float[np.ndarray, "v 3"]] | None:
    """Return vertices, faces and unit vertex normals of the zero set of `values`; None for an empty set.

    Marching cubes computes the mesh, which is in scene coordinates. Faces and normals point outward.

    - `values`: one value per node of the grid, positive outside the solid.
    """
    if not values.min() < 0 < values.max():
        return None
    marching_cubes, spacing = optional("skimage.measure").marching_cubes, (grid.spacing,) * 3
    vertices, faces, normals, _ = marching_cubes(values, 0.0, spacing=spacing, gradient_direction="descent")
    lengths = np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return vertices - grid.half_extent, faces, -normals / lengths


def supported_pieces(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    points: Float[np.ndarray, "n 3"],
    max_distance: float,
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "k 3"], int]:
    """Return a mesh without the connected components that have fewer than four of the points nearby.

    Return the vertices and faces of all other components, and the number of components left out. A point belongs to the
    component of its nearest vertex, if this vertex is within `max_distance`. If no component has four points, only the
    components with the most points remain.
    """
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    graph = coo_array((np.ones(len(edges), bool), edges.T), (len(vertices), len(vertices)))
    count, component = connected_components(graph, directed=False)
    distance, nearest = cKDTree(vertices).query(points)
    num_points = np.bincount(component[nearest[distance <= max_distance]], minlength=count)
    is_supported = num_points >= min(_MIN_POINTS, num_points.max())
    vertex_rows, new_faces = np.unique(faces[is_supported[component[faces[:, 0]]]], return_inverse=True)
    return vertices[vertex_rows], new_faces.reshape(-1, 3), int(np.sum(~is_supported))


@checked
def mesh_from_sdf(sdf: SignedDistance, grid: Grid) -> TriangleMesh:
    """Convert a solid to a mesh in scene coordinates (identity frame), by marching cubes on a grid.

    **Raises:** `ValueError` if no surface lies within the grid.
    """
    values = np.array(on_tensor_grid(sdf, grid.axis))
    triangles = level_triangles(values, grid)
    if triangles is None:
        raise InputError(
            f"the solid's distances on the grid run from {values.min():.4g} to {values.max():.4g}: no surface lies "
            f"within [-{grid.half_extent}, {grid.half_extent}]^3; move the solid, or give Grid(half_extent=...) that "
            "holds it"
        )
    return TriangleMesh(triangles[0], triangles[1], Frame())
