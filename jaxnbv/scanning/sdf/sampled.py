"""Meshes and points as solids that can be traced within JAX: their signed distances, sampled on grids."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import cKDTree

from jaxnbv.checks import AnyArray, as_numbers, checked, require
from jaxnbv.scanning.sdf.base import Scalar, SignedDistance, Vector, nonnegative, norm, parameter, split
from jaxnbv.scanning.triangles import distance_to_triangles, winding_number

# Of the longest side, on all sides.
_PADDING = 0.1
# Gaps between points that are closed, in cells and in distances between neighbours: n places at random
# leave gaps of up to sqrt(x / ln 2) times the median distance, with 2 n x exp(-x) = 1: of 8,192 it is 4.2.
_CELLS_CLOSED, _NEIGHBOURS_CLOSED, _WIDEST_GAP = 1.5, 4.5, 0.5


class Sampled(SignedDistance):
    """A solid by its signed distances at the nodes of a grid, trilinear between them. Right to about a cell within the
    grid, a bound beyond it.

    - `values`: at the nodes; `low`: the first of them; `spacing`: between them.
    - `padding`: by how much the grid is larger than the solid on all sides.
    """

    values: Float[Array, "a b c"] = parameter()
    low: Vector = parameter()
    spacing: Scalar = nonnegative()
    padding: Scalar = nonnegative()

    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        high = self.low + self.spacing * (jnp.array(self.values.shape) - 1)
        nearest = jnp.clip(x, self.low, high)
        places = jnp.moveaxis((nearest - self.low) / self.spacing, -1, 0)
        found = jax.scipy.ndimage.map_coordinates(self.values, list(places), order=1, mode="nearest")
        beyond = norm(*split(x - nearest))
        return jnp.where(beyond > 0, beyond + self.padding, found)


@checked
def solid_of_mesh(
    vertices: Float[AnyArray, "v 3"],
    faces: Int[AnyArray, "f 3"],
    resolution: int = 64,
    sheet: float = 0.0,
    cubic: bool = False,
) -> Sampled:
    """A mesh as a solid, in the coordinates of its vertices: an obstacle, say. Its inside is told by winding numbers,
    so that it may have holes.

    - `resolution`: nodes along its longest side.
    - `sheet`: how thick faces are that have the outside on both sides; without thickness they vanish.
    - `cubic`: as many nodes along all sides, so that solids of several meshes can be stacked.

    **Raises:** `ValueError` for other shapes, indices out of range, or a resolution below four.
    """
    vertices = as_numbers(vertices, "the mesh's vertices", np.float64)
    faces = as_numbers(faces, "the mesh's faces", np.int64)
    for name, array in (("vertices", vertices), ("faces", faces)):
        require(
            array.ndim == 2 and array.shape[1] == 3 and len(array) > 0,
            f"the mesh's {name} must be (n, 3), got {array.shape}",
        )
    require(
        faces.min() >= 0 and faces.max() < len(vertices),
        f"faces refer to vertices {faces.min()} to {faces.max()}, but there are {len(vertices)}",
    )
    require(bool(np.isfinite(vertices).all()), "the mesh has vertices that are not finite")
    require(resolution >= 4, f"the resolution is {resolution}; it must be at least 4")
    lattice = _Lattice.about(vertices, "vertices of the mesh", resolution, cubic)
    return lattice.solid(_signed_distance(lattice.nodes, vertices, faces, sheet))


@checked
def solid_of_points(points: Float[AnyArray, "n 3"], resolution: int = 64, sheet: float = 0.05) -> Sampled:
    """Points all over a surface as a solid, in their coordinates; they need no normals. Its outside is what can be
    reached from beyond them through no gap as narrow as those between them, which are closed.

    - `resolution`: nodes along its longest side; there are as many along all sides.
    - `sheet`: how thick the surface is where it encloses nothing.

    **Raises:** `ValueError` for other shapes, points that are not finite or too few to tell a surface, or a resolution
    below 16.
    """
    points = as_numbers(points, "the points", np.float64)
    require(points.ndim == 2 and points.shape[1] == 3, f"the points must be (n, 3), got {points.shape}")
    require(bool(np.isfinite(points).all()), "the points are not all finite")
    require(resolution >= 16, f"the resolution is {resolution}; it must be at least 16")
    # A point that is there twice would be its own neighbour.
    points = np.unique(points, axis=0)
    require(len(points) >= 4, f"there are {len(points)} different points; give four or more")
    tree, longest = cKDTree(points), float(np.ptp(points, axis=0).max())
    gap = _NEIGHBOURS_CLOSED * float(np.median(tree.query(points, k=2)[0][:, 1]))
    require(
        gap < _WIDEST_GAP * longest,
        f"the points are {gap / _NEIGHBOURS_CLOSED:.3g} apart, too far to tell a surface of {longest:.3g}: give more",
    )
    # The outside must go round all that is closed.
    room = gap / longest + (_CELLS_CLOSED + 1.0) / (resolution - 1)
    lattice = _Lattice.about(points, "points", resolution, cubic=True, padding=max(_PADDING, 1.3 * room))
    away = tree.query(lattice.nodes)[0].reshape(lattice.counts)
    closed = max(_CELLS_CLOSED * lattice.spacing, gap)
    regions, _ = scipy.ndimage.label(away > closed)
    outside = regions == regions[0, 0, 0]
    # A node outside and its neighbour within stand half a cell each from where the distance is `closed`.
    deep = lattice.spacing * (scipy.ndimage.distance_transform_edt(~outside) - 0.5)
    return lattice.solid(np.where(outside, away, closed - deep) - 0.5 * sheet)


class _Lattice(NamedTuple):
    """Nodes of a grid about some places, with room on all sides."""

    low: Float[np.ndarray, "3"]
    spacing: float
    counts: Int[np.ndarray, "3"]
    padding: float

    @classmethod
    def about(
        cls, places: Float[np.ndarray, "n 3"], name: str, resolution: int, cubic: bool, padding: float = _PADDING
    ) -> "_Lattice":
        low, high = places.min(axis=0), places.max(axis=0)
        longest = float((high - low).max())
        require(longest > 0, f"all {len(places)} {name} lie at {low}")
        if cubic:
            middle = 0.5 * (low + high)
            low, high = middle - 0.5 * longest, middle + 0.5 * longest
        spacing = (1.0 + 2.0 * padding) * longest / (resolution - 1)
        low = low - padding * longest
        counts = np.ceil((high + padding * longest - low) / spacing - 1e-6).astype(int) + 1
        return cls(low, spacing, counts, padding * longest)

    @property
    def nodes(self) -> Float[np.ndarray, "n 3"]:
        axes = [start + self.spacing * np.arange(count) for start, count in zip(self.low, self.counts, strict=True)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)

    def solid(self, distance: Float[np.ndarray, "..."]) -> Sampled:
        """That of the distances at the nodes."""
        return Sampled(jnp.asarray(distance.reshape(self.counts)), self.low, self.spacing, self.padding)


def _signed_distance(
    points: Float[np.ndarray, "n 3"], vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], sheet: float
) -> Float[np.ndarray, " n"]:
    distance = distance_to_triangles(points, vertices, faces)
    signed = np.where(_is_inside(points, vertices, faces), -distance, distance)
    if sheet == 0:
        return signed
    corners = vertices[faces]
    middle, normal = corners.mean(axis=1), np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.finfo(float).tiny)
    step = 1e-4 * np.ptp(vertices, axis=0).max() * normal
    thin = ~(_is_inside(middle + step, vertices, faces) | _is_inside(middle - step, vertices, faces))
    if not thin.any():
        return signed
    beside = distance_to_triangles(points, vertices, faces[thin])
    return np.minimum(signed, beside - 0.5 * sheet)


def _is_inside(
    points: Float[np.ndarray, "n 3"], vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> Bool[np.ndarray, " n"]:
    # Of a solid whose faces are wound the other way the number is negative.
    return np.abs(winding_number(points, vertices, faces)) > 0.5
