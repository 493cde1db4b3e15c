"""How good a set of views was, measured against the true surface: coverage, Chamfer and Hausdorff distance."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, PRNGKeyArray
from scipy.spatial import cKDTree

from jaxnbv.checks import AnyArray, as_numbers, require
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.scanning.grid import Grid
from jaxnbv.scanning.mesh import TriangleMesh, mesh_from_sdf
from jaxnbv.scanning.sphere_tracing import SDFSurface
from jaxnbv.scanning.surface import Surface

# Of the authors: points that each of the two surfaces is sampled at.
SURFACE_POINTS = 20_000


def coverage(cloud: PointCloud, truth: Float[AnyArray, "n 3"], radius: float = 0.05) -> float:
    """Share of the true surface that lies near the cloud: of the n points of `truth`, those whose nearest point of the
    cloud is at most `radius` away (both in scene units); in [0, 1].

    With points that are uniform by area it is a share of area. Surface that no camera can see, such as the walls of a
    closed cavity, counts as not covered, so a complete scan may stay below 1. The cloud's normals are not used: a sheet
    thinner than `radius` is covered from either side. A cloud without points covers nothing.

    **Raises:** `ValueError` if `truth` is empty or not finite, or `radius` <= 0.
    """
    truth = _points(truth, "true surface")
    require(radius > 0, f"the radius is {radius}; it must be positive, in scene units")
    points, _ = cloud.to_numpy()
    if not len(points):
        return 0.0
    distance, _ = cKDTree(points.astype(np.float64)).query(truth)
    return float(np.mean(distance <= radius))


def truth_points(scene: Surface, key: PRNGKeyArray, count: int = SURFACE_POINTS) -> Float[np.ndarray, "count 3"] | None:
    """`count` points of a known surface, uniform by area, in scene coordinates; None for a kind of surface that cannot
    be sampled.

    Meshes are sampled as they are, a signed distance on its marching-cubes mesh over the scene's grid.
    """
    mesh = true_mesh(scene)
    return None if mesh is None else mesh.sample_points(key, count)


def true_mesh(scene: Surface) -> TriangleMesh | None:
    """A known surface as triangles in scene coordinates: a mesh as it is, a signed distance by marching cubes over the
    scene's grid; None for another kind."""
    if isinstance(scene, SDFSurface):
        return mesh_from_sdf(scene.sdf, Grid())
    return scene if isinstance(scene, TriangleMesh) else None


class SurfaceDistance(NamedTuple):
    """Distances between a reconstruction R and the truth T, each given by points of it, in scene units.

    With d(x, Y) = min_{y in Y} |x - y|, not squared:

    - `accuracy`: mean_{x in R} d(x, T), large where the reconstruction has surface that is not there;
    - `completeness`: mean_{y in T} d(y, R), large where it lacks some;
    - `hausdorff`: max(max_{x in R} d(x, T), max_{y in T} d(y, R)).
    """

    accuracy: float
    completeness: float
    hausdorff: float

    @property
    def chamfer(self) -> float:
        """accuracy + completeness: the sum of both directions, which is of the size of the paper's numbers."""
        return self.accuracy + self.completeness


def surface_distance(reconstruction: Float[AnyArray, "n 3"], truth: Float[AnyArray, "m 3"]) -> SurfaceDistance:
    """Chamfer and Hausdorff distance between two surfaces, from points of each (`TriangleMesh.sample_points`).

    Both are symmetric. Two samples of one surface do not coincide: n points that are uniform on an area A have a mean
    distance of about sqrt(A / n) / 2 to another sample, which is 0.01 for 20,000 points and an area of 8, and so a
    Chamfer distance of twice that.

    **Raises:** `ValueError` if either has no points, or some that are not finite.
    """
    found, true = _points(reconstruction, "reconstruction"), _points(truth, "true surface")
    from_found, from_true = cKDTree(true).query(found)[0], cKDTree(found).query(true)[0]
    hausdorff = max(float(from_found.max()), float(from_true.max()))
    return SurfaceDistance(float(from_found.mean()), float(from_true.mean()), hausdorff)


def _points(points: Float[AnyArray, "n 3"], name: str) -> Float[np.ndarray, "n 3"]:
    points = as_numbers(points, f"the {name}", np.float64)
    require(points.ndim == 2 and points.shape[1] == 3, f"the {name} has shape {points.shape}: give points (n, 3)")
    require(len(points) > 0, f"the {name} has no points: sample it with mesh.sample_points(key, count)")
    require(bool(np.isfinite(points).all()), f"the {name} has points that are not finite: drop them")
    return points
