"""How good a set of views was, measured against the true surface."""

import numpy as np
from jaxtyping import Float, PRNGKeyArray
from scipy.spatial import cKDTree

from jaxnbv.checks import AnyArray, require
from jaxnbv.cloud import PointCloud
from jaxnbv.scanning import Grid, SDFSurface, Surface, TriangleMesh, mesh_from_sdf


def coverage(cloud: PointCloud, truth: Float[AnyArray, "n 3"], radius: float = 0.05) -> float:
    """Share of the true surface that lies near the cloud: of the n points of `truth`, those whose nearest point of the
    cloud is at most `radius` away (both in scene units); in [0, 1].

    With points that are uniform by area it is a share of area. Surface that no camera can see, such as the walls of a
    closed cavity, counts as not covered, so a complete scan may stay below 1. The cloud's normals are not used: a sheet
    thinner than `radius` is covered from either side. A cloud without points covers nothing.

    **Raises:** `ValueError` if `truth` is empty or not finite, or `radius` <= 0.
    """
    truth = np.asarray(truth, dtype=np.float64)
    require(len(truth) > 0, "the true surface has no points: sample it with truth_points(scene, key)")
    require(bool(np.isfinite(truth).all()), "the true surface has points that are not finite: drop them")
    require(radius > 0, f"the radius is {radius}; it must be positive, in scene units")
    points, _ = cloud.to_numpy()
    if not len(points):
        return 0.0
    distance, _ = cKDTree(points.astype(np.float64)).query(truth)
    return float(np.mean(distance <= radius))


def truth_points(scene: Surface, key: PRNGKeyArray, count: int = 20_000) -> Float[np.ndarray, "count 3"] | None:
    """`count` points of a known surface, uniform by area, in scene coordinates; None for a kind of surface that cannot
    be sampled.

    Meshes are sampled as they are, a signed distance on its marching-cubes mesh over the scene's grid.
    """
    if isinstance(scene, SDFSurface):
        scene = mesh_from_sdf(scene.sdf, Grid())
    return scene.sample_points(key, count) if isinstance(scene, TriangleMesh) else None
