"""Conversion of meshes to solids that JAX can trace, by sampling their signed distances on grids."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxnbv.checks import AnyArray, as_numbers, checked, require
from jaxnbv.errors import optional
from jaxnbv.geometry.rotations import safe_norm
from jaxnbv.scanning.sdf.base import Scalar, SignedDistance, Vector, nonnegative, parameter, split

# Width of the empty space between the mesh and the sides of the grid, as a fraction of the mesh's longest side.
_PADDING = 0.1


class Sampled(SignedDistance):
    """A solid whose signed distance is interpolated linearly between the nodes of a grid.

    The distance is accurate to about a cell inside the grid. Outside the grid it is a lower bound, which is continuous
    at the grid's sides.

    - `values`: signed distances at the nodes.
    - `low`, `spacing`: position of the first node, and the distance between neighbouring nodes.
    - `padding`: width of the empty space between the solid and the sides of the grid.
    """

    values: Float[Array, "a b c"] = parameter()
    low: Vector = parameter()
    spacing: Scalar = nonnegative()
    padding: Scalar = nonnegative()

    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        high = self.low + self.spacing * (jnp.array(self.values.shape) - 1)
        nearest = jnp.clip(x, self.low, high)
        coordinates = jnp.moveaxis((nearest - self.low) / self.spacing, -1, 0)
        inside = jax.scipy.ndimage.map_coordinates(self.values, list(coordinates), order=1, mode="nearest")
        beyond = safe_norm(*split(x - nearest))
        # The grid is convex. So from a point of the solid, x is at least as far as the hypotenuse over the distance to
        # `nearest` and the distance from there to x.
        bound = jnp.maximum(beyond + self.padding, safe_norm(beyond, inside))
        return jnp.where(beyond > 0, bound, inside)


@checked
def solid_of_mesh(
    vertices: Float[AnyArray, "v 3"],
    faces: Int[AnyArray, "f 3"],
    resolution: int = 64,
    sheet: float = 0.0,
    cubic: bool = False,
) -> Sampled:
    """Convert a mesh to a solid in the coordinates of its vertices, for example to use it as an obstacle.

    Inside and outside follow from winding numbers, so the mesh may have holes.

    - `resolution`: number of nodes along the longest side of the grid.
    - `sheet`: thickness that is given to faces with the outside on both sides. If it is 0, such faces vanish.
    - `cubic`: use `resolution` nodes along all sides, so that the solids of different meshes can be stacked.

    **Raises:** `ValueError` if `TriangleMesh.from_arrays` refuses the triangles, all vertices coincide, or the
    resolution is below four.
    """
    vertices, faces = checked_triangles(vertices, faces)
    require(resolution >= 4, f"the resolution is {resolution}; it must be at least 4")
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    longest = float((high - low).max())
    require(longest > 0, f"all {len(vertices)} vertices of the mesh lie at {low}")
    if cubic:
        middle = 0.5 * (low + high)
        low, high = middle - 0.5 * longest, middle + 0.5 * longest
    padding = _PADDING * longest
    spacing = (1.0 + 2.0 * _PADDING) * longest / (resolution - 1)
    low = low - padding
    counts = np.ceil((high + padding - low) / spacing - 1e-6).astype(int) + 1
    axes = [start + spacing * np.arange(count) for start, count in zip(low, counts, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    distance = _signed_distance(nodes, vertices, faces, sheet)
    return Sampled(jnp.asarray(distance.reshape(counts)), low, spacing, padding)


def _signed_distance(
    points: Float[np.ndarray, "n 3"], vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], sheet: float
) -> Float[np.ndarray, " n"]:
    distance = distance_to_triangles(points, vertices, faces)
    signed = np.where(is_inside(points, vertices, faces), -distance, distance)
    if sheet == 0:
        return signed
    corners = vertices[faces]
    middle, normal = corners.mean(axis=1), np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.finfo(float).tiny)
    step = 1e-4 * np.ptp(vertices, axis=0).max() * normal
    is_thin = ~(is_inside(middle + step, vertices, faces) | is_inside(middle - step, vertices, faces))
    if not is_thin.any():
        return signed
    sheet_distance = distance_to_triangles(points, vertices, faces[is_thin])
    return np.minimum(signed, sheet_distance - 0.5 * sheet)


def is_inside(
    points: Float[np.ndarray, "n 3"], vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> Bool[np.ndarray, " n"]:
    """Return, for each point, whether triangles of any winding enclose it. Open sheets enclose nothing."""
    return np.abs(winding_number(points, vertices, faces)) > 0.5


def checked_triangles(vertices: Any, faces: Any) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Convert vertices and faces to arrays, and check that they are a mesh of triangles.

    **Raises:** `ValueError` for a shape other than (n, 3), no faces, an invalid index, or a vertex that is not finite.
    """
    vertices = as_numbers(vertices, "the mesh's vertices", np.float64)
    faces = as_numbers(faces, "the mesh's faces", None)
    require(
        faces.size > 0,
        "the mesh has no faces: a point cloud or an empty file cannot be scanned; give a triangle mesh",
    )
    for name, array in (("vertices", vertices), ("faces", faces)):
        require(array.ndim == 2 and array.shape[1] == 3, f"the mesh's {name} must be (n, 3), got {array.shape}")
    require(faces.dtype.kind in "iu", f"faces are rows of vertex indices and must be integers, got {faces.dtype}")
    low, high = int(faces.min()), int(faces.max())
    require(
        low >= 0 and high < len(vertices),
        f"faces refer to vertices {low} to {high}, but there are {len(vertices)}, counted from 0: "
        "renumber or drop these faces",
    )
    bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    require(
        bad.size == 0,
        f"{bad.size} vertices of the mesh are not finite, the first at row {bad[:1]}: "
        "drop them and the faces that use them",
    )
    return vertices, faces


def distance_to_triangles(
    points: Float[np.ndarray, "n 3"], vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> Float[np.ndarray, " n"]:
    """Return the unsigned distance from each point to the nearest triangle."""
    return np.sqrt(optional("igl").point_mesh_squared_distance(points, vertices, faces)[0])


def winding_number(
    points: Float[np.ndarray, "n 3"], vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> Float[np.ndarray, " n"]:
    """Return the winding number of the triangles around each point (Barill et al. 2018).

    It is 0 outside a closed mesh, 1 inside (-1 if wound inside out), and in between near a hole.
    """
    return np.asarray(optional("igl").fast_winding_number(vertices, faces, points))
