"""How far a reconstructed surface is from the true one: Chamfer and Hausdorff distance."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from jaxnbv.checks import AnyArray, require

# Of the authors: points that each of the two surfaces is sampled at.
SURFACE_POINTS = 20_000


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
    found, true = (np.asarray(points, dtype=np.float64) for points in (reconstruction, truth))
    for name, points in (("reconstruction", found), ("true surface", true)):
        require(len(points) > 0, f"the {name} has no points: sample it with mesh.sample_points(key, count)")
        require(bool(np.isfinite(points).all()), f"the {name} has points that are not finite: drop them")
    from_found, from_true = cKDTree(true).query(found)[0], cKDTree(found).query(true)[0]
    hausdorff = max(float(from_found.max()), float(from_true.max()))
    return SurfaceDistance(float(from_found.mean()), float(from_true.mean()), hausdorff)
