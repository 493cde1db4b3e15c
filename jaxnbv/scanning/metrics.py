"""How good a set of views was, measured against the true surface: coverage, Chamfer and Hausdorff distance."""

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

# Of the authors: points that each of the two surfaces is sampled at.
SURFACE_POINTS = 20_000
# The least cosine of incidence at which a pixel shows all of the plane that it meets.
GRAZING = 0.2


def coverage(views: Iterable[Any], truth: Float[AnyArray, "n 3"], size: float = 0.05) -> list[float]:
    """Share in [0, 1] of the n points of `truth` that a pixel of a view, or of one before it, shows; after each view.

    - `views`: those of an episode, or others that have a `scan`, the `camera` that took it, and the `pose`.
    - `size`: how far before or behind its pixel's hit a point may be; sensor noise is to be well below it.

    With points that are uniform by area it is a share of area. Surface that no camera can see, such as the walls of a
    closed cavity, counts as not covered. A sheet thinner than `size` is covered from either side.

    **Raises:** `ValueError` if `truth` is empty or not finite, `size` <= 0, or a scan is no image of its camera.
    """
    truth = _points(truth, "true surface")
    require(size > 0, f"the size is {size}; it must be positive, in scene units")
    seen = np.zeros(len(truth), bool)
    shares = []
    for view in views:
        seen |= shows(view.scan, view.camera, view.pose, truth, size)
        shares.append(float(seen.mean()))
    return shares


def shows(
    scan: PointCloud, camera: Camera, pose: Pose, truth: Float[np.ndarray, "n 3"], size: float
) -> Bool[np.ndarray, " n"]:
    """Whether a scan shows each of some points of the true surface: the point is as far away as the hit of the pixel
    that it falls into, to `size` and to what the hit's plane gains within half a pixel.

    **Raises:** `ValueError` if the scan is no image of the camera.
    """
    points, normals, mask = (np.asarray(rows) for rows in (scan.points, scan.normals, scan.mask))
    require(
        points.shape == (camera.num_rays, 3),
        f"the scan has rows of shape {points.shape[:-1]} but the camera {camera.height} x {camera.width} rays: give "
        "the camera that took it",
    )
    position, rotation = np.asarray(pose.position, np.float64), np.asarray(pose.rotation, np.float64)
    local = (truth - position) @ rotation
    ahead = local[:, 2] > 0
    column, row = np.floor(camera.to_pixels(local[:, :2] / np.where(ahead, local[:, 2], 1.0)[:, None])).T
    inside = ahead & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    pixel = np.where(inside, row * camera.width + column, 0).astype(int)

    ray = points - position
    distance = np.linalg.norm(ray, axis=1)
    cosine = np.maximum(np.abs(np.sum(ray * normals, axis=1)) / np.maximum(distance, 1e-12), GRAZING)
    gain = 0.5 * math.hypot(*(1.0 / f for f in camera.focal_lengths)) * distance * np.sqrt(1.0 / cosine**2 - 1.0)
    farther = np.linalg.norm(local, axis=1) - distance[pixel]
    return inside & mask[pixel] & (np.abs(farther) <= size + gain[pixel])


def truth_points(scene: Surface, key: PRNGKeyArray, count: int = SURFACE_POINTS) -> Float[np.ndarray, "count 3"] | None:
    """`count` points of the `true_mesh`, uniform by area, in scene coordinates; None where there is none."""
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

    Two samples of one surface do not coincide: n points that are uniform on an area A have a mean distance of about
    sqrt(A / n) / 2 to another sample, and so a Chamfer distance of twice that.

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
