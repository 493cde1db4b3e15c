"""Comparison of views and reconstructions with the true surface, by coverage and surface distances."""

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray
from scipy.spatial import cKDTree

from jaxnbv.checks import AnyArray, as_numbers, require
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose
from jaxnbv.scanning.grid import Grid
from jaxnbv.scanning.mesh import TriangleMesh, mesh_from_sdf
from jaxnbv.scanning.scanner import Surface
from jaxnbv.scanning.sphere_tracing import SDFSurface

# Number of points that the paper's authors sample on each of two surfaces to compare them.
SURFACE_POINTS = 20_000
# A ray whose cosine of incidence is below this value counts as grazing.
GRAZING = 0.2


def coverage(views: Iterable[Any], truth: Float[AnyArray, "n 3"], size: float = 0.05) -> list[float]:
    """Return, for each view, the fraction of true surface points that this or an earlier view shows.

    If the points are uniform by area, the result is a fraction of the area. Surface that no camera can see, such as in
    a closed cavity, counts as not covered. A view from either side covers both sides of a sheet thinner than `size`.

    - `views`: the views of an episode, or other objects with the attributes `scan`, `camera` and `pose`.
    - `truth`: points on the true surface, in scene coordinates. `size` is in the same units.
    - `size`: largest distance along the ray between a covered point and its pixel's hit. Give more than the noise.

    **Raises:** `ValueError` if `truth` is empty or not finite, `size` <= 0, or a scan does not have one row per ray.
    """
    truth = _points(truth, "true surface")
    require(size > 0, f"the size is {size}; it must be positive, in scene units")
    is_covered = np.zeros(len(truth), bool)
    fractions = []
    for view in views:
        is_covered |= is_shown(view.scan, view.camera, view.pose, truth, size)
        fractions.append(float(is_covered.mean()))
    return fractions


def is_shown(
    scan: PointCloud, camera: Camera, pose: Pose, truth: Float[np.ndarray, "n 3"], size: float
) -> Bool[np.ndarray, " n"]:
    """Return, for each point of the true surface, whether a scan shows the point.

    A scan shows a point if the point's pixel has a hit that is equally far from the camera. The distances may differ by
    `size` plus the change of distance over half a pixel's diagonal on the tangent plane at the hit.

    **Raises:** `ValueError` if the scan does not have one row per ray of the camera.
    """
    points, normals, mask = (np.asarray(rows) for rows in (scan.points, scan.normals, scan.mask))
    require(
        points.shape == (camera.num_rays, 3),
        f"the scan has rows of shape {points.shape[:-1]} but the camera {camera.height} x {camera.width} rays: give "
        "the camera that took it",
    )
    position, rotation = np.asarray(pose.position, np.float64), np.asarray(pose.rotation, np.float64)
    local = (truth - position) @ rotation
    is_ahead = local[:, 2] > 0
    column, row = np.floor(camera.to_pixels(local[:, :2] / np.where(is_ahead, local[:, 2], 1.0)[:, None])).T
    is_inside = is_ahead & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    pixel = np.where(is_inside, row * camera.width + column, 0).astype(int)

    ray = points - position
    distance = np.linalg.norm(ray, axis=1)
    cosine = np.maximum(np.abs(np.sum(ray * normals, axis=1)) / np.maximum(distance, 1e-12), GRAZING)
    tolerance = 0.5 * math.hypot(*(1.0 / f for f in camera.focal_lengths)) * distance * np.sqrt(1.0 / cosine**2 - 1.0)
    farther = np.linalg.norm(local, axis=1) - distance[pixel]
    return is_inside & mask[pixel] & (np.abs(farther) <= size + tolerance[pixel])


def truth_points(scene: Surface, key: PRNGKeyArray, count: int = SURFACE_POINTS) -> Float[np.ndarray, "count 3"] | None:
    """Draw `count` points (scene coordinates) on `true_mesh(scene)`, uniform by area; None without a mesh."""
    mesh = true_mesh(scene)
    return None if mesh is None else mesh.sample_points(key, count)


def true_mesh(scene: Surface) -> TriangleMesh | None:
    """Return a `TriangleMesh` unchanged, the mesh of an `SDFSurface` on the default grid, or else None."""
    if isinstance(scene, SDFSurface):
        return mesh_from_sdf(scene.sdf, Grid())
    return scene if isinstance(scene, TriangleMesh) else None


class SurfaceDistance(NamedTuple):
    """Distances between points of a reconstruction R and points of the true surface T, in scene units.

    The distance from a point to a set is d(x, Y) = min_{y in Y} |x - y|, which is not squared.

    - `accuracy`: mean_{x in R} d(x, T). It is large if the reconstruction has surface that does not exist.
    - `completeness`: mean_{y in T} d(y, R). It is large if the reconstruction lacks surface.
    - `hausdorff`: max(max_{x in R} d(x, T), max_{y in T} d(y, R)).
    """

    accuracy: float
    completeness: float
    hausdorff: float

    @property
    def chamfer(self) -> float:
        """Chamfer distance: accuracy + completeness. The paper's values seem to be this sum too."""
        return self.accuracy + self.completeness


def surface_distance(reconstruction: Float[AnyArray, "n 3"], truth: Float[AnyArray, "m 3"]) -> SurfaceDistance:
    """Compute the Chamfer and Hausdorff distance between two surfaces from points on each surface.

    Sample the points with `TriangleMesh.sample_points`. The distance between two samples of the same surface is not
    zero: for n points, uniform on an area A, `accuracy` and `completeness` are about sqrt(A / n) / 2.

    **Raises:** `ValueError` if `reconstruction` or `truth` has no points or has points that are not finite.
    """
    points, true = _points(reconstruction, "reconstruction"), _points(truth, "true surface")
    from_points, from_true = cKDTree(true).query(points)[0], cKDTree(points).query(true)[0]
    hausdorff = max(float(from_points.max()), float(from_true.max()))
    return SurfaceDistance(float(from_points.mean()), float(from_true.mean()), hausdorff)


def _points(points: Float[AnyArray, "n 3"], name: str) -> Float[np.ndarray, "n 3"]:
    points = as_numbers(points, f"the {name}", np.float64)
    require(points.ndim == 2 and points.shape[1] == 3, f"the {name} has shape {points.shape}: give points (n, 3)")
    require(len(points) > 0, f"the {name} has no points: sample it with mesh.sample_points(key, count)")
    require(bool(np.isfinite(points).all()), f"the {name} has points that are not finite: drop them")
    return points
