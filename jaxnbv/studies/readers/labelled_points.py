"""Points of an object whose class is known."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxnbv.checks import InputError, require
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.frame import Frame


class LabelledPoints(NamedTuple):
    """The points of one object, in the units of its file.

    - `points`, `normals`: as in the file; the y axis points up. None for a data set without normals.
    - `label`: the place of its class in the data set's `classes`.
    - `name`: the object's.
    """

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"] | None
    label: int
    name: str

    def normalised(self) -> "LabelledPoints":
        """As the published networks expect them: in the unit sphere about their centre."""
        return self._replace(points=unit_sphere(self.points))

    def to_cloud(self, frame: Frame) -> PointCloud:
        """The points as a cloud in scene coordinates, row for row.

        **Raises:** `ValueError` if there are no normals, or as `PointCloud.from_arrays` does.
        """
        if self.normals is None:
            raise InputError(f"{self.name} has points without normals: scan its mesh, or estimate them")
        return frame.to_scene(PointCloud.from_arrays(self.points, self.normals))


def unit_sphere(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """The points moved so that their mean is the origin, and scaled so that the farthest from it has distance 1.

    **Raises:** `ValueError` if there are no points, or all coincide.
    """
    require(len(points) > 0, "there are no points to normalise: give at least two")
    centred = points - points.mean(axis=0)
    radius = np.linalg.norm(centred, axis=1).max()
    require(radius > 0, f"all {len(points)} points lie at {points[0]}; give points that differ")
    return centred / radius
