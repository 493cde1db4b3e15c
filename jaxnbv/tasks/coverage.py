"""Coverage: acquisitions for new surface, and the fraction of the surface that has been seen."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxnbv.acquisition import Acquisition, ImaginedView
from jaxnbv.checks import check_fields, require
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.neighbours import NearestPoints, spacing
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.pose_list import PoseList
from jaxnbv.programs import program
from jaxnbv.sampler import StepInputs
from jaxnbv.scanning import GridSurface, Looks, pixel_area
from jaxnbv.scanning.looks import STEEP
from jaxnbv.scanning.visibility import is_visible, spread_points
from jaxnbv.sharding import shared_map
from jaxnbv.utility import Quantity

# Default size s of `NewSurface` in scene units, for observations without `Looks`.
_SIZE = 0.05
# Number of points on each sample for `seen_share`. This number makes the result accurate to a percent.
_POINTS = 1024


class Coverage(Acquisition):
    """Chamfer distance from a simulated scan to the cloud D, sum_{x in scan} min_{y in D} |x - y|^2.

    This is the paper's alpha^(CD), in squared scene units. Distances are looked up on a grid, see `NearestPoints`.
    """

    def context(self, step: StepInputs) -> NearestPoints:
        """Return the cloud D, with a grid that makes distances to it fast."""
        return NearestPoints.of(step.observations.cloud)

    def score(self, context: NearestPoints, view: ImaginedView) -> Float[Array, ""]:
        """Return the unidirectional Chamfer distance from the scan to D, which is zero for an empty scan."""
        return jnp.sum(jnp.where(view.scan.mask, context.squared_distance(view.scan.points), 0.0))

    @property
    def quantity(self) -> Quantity:
        meaning = "squared distances to the cloud, summed over an imagined scan, mean over posterior samples."
        return Quantity("expected coverage gain", "", meaning, length_power=2)


class Newness(eqx.Module):
    """Newness clip(d / s - 1, 0, 1) of a surface, as a function of points on it, see `NewSurface`.

    - `distances`: function from points to d, the distance to the nearest hit of earlier views. For observations without
      `Looks`, d is the distance to the nearest point of the cloud.
    - `size`: the length s, in scene units.
    """

    distances: Looks | NearestPoints
    size: Float[Array, ""]

    def __call__(self, points: Float[Array, "n 3"]) -> Float[Array, " n"]:
        """Return the newness of the surface at each point, from 0 (seen) to 1 (new)."""
        return jnp.clip(self.distances(points) / self.size - 1.0, 0.0, 1.0)


class NewSurface(Acquisition):
    """Area in a simulated scan that no view has measured yet, in squared scene units.

        alpha(D, scan) = sum_x a(x) clip(d(x) / s - 1, 0, 1),   a(x) = r^2 omega / cos

    The sum is over the hits x of the scan. d(x) is the distance from x to the nearest hit of any earlier view, see
    `Looks`. A hit x counts as seen if d(x) <= s, as new if d(x) >= 2 s, and as partly new in between. a(x) is the area
    of the pixel on the surface: omega is the pixel's solid angle, r the distance from the camera, and cos the cosine of
    the angle of incidence, clipped to at least 0.5. Rays of one scan do not overlap, so no surface counts twice. In the
    paper's `Coverage`, near surfaces may dominate because they fill more pixels, and a single far point may dominate
    too. In `NewSurface`, neither does.

    Use a search over candidates. `NewSurface` is differentiable in the pose wherever `Coverage` is, but most of its
    gain comes from rays that jump to a different surface, and the derivative ignores such jumps.

    - `size`: the length s in scene units, even in sessions. The default is the spacing of the grid of `Looks`. A
      smaller size is raised to this spacing.

    For observations without `Looks`, such as a single cloud, or if 2 s exceeds `Looks.reach`, d(x) is the distance to
    the nearest point of the cloud D. The default of s is then 0.05. A size below the median distance between nearest
    neighbours in D is raised to this distance.

    **Raises:** `ValueError` if the size is not positive.
    """

    size: float | None = eqx.field(static=True, default=None)
    measurable_only: ClassVar[bool] = True
    gains_once: ClassVar[bool] = True

    def __check_init__(self):
        check_fields(self)
        require(self.size is None or self.size > 0, f"the size is {self.size}; it must be positive, in scene units")

    def context(self, step: StepInputs) -> Newness:
        cloud, looks = step.observations.cloud, step.observations.looks
        if looks is not None and 2.0 * (self.size or 0.0) <= looks.reach:
            return Newness(looks, jnp.asarray(max(looks.grid.spacing, self.size or 0.0), cloud.points.dtype))
        size = jnp.maximum(_SIZE if self.size is None else self.size, spacing(cloud))
        return Newness(NearestPoints.of(cloud), size)

    def score(self, context: Newness, view: ImaginedView) -> Float[Array, ""]:
        """Return the new area in one scan, in squared scene units."""
        return jnp.sum(pixel_area(view.scan, view.camera, view.pose, STEEP) * context(view.scan.points))

    @property
    def quantity(self) -> Quantity:
        meaning = "area that an imagined scan shows and no scan has shown before, mean over posterior samples."
        return Quantity("expected new area", "", meaning, length_power=2)


def new_surface_of(acquisition: Acquisition) -> NewSurface:
    """Return the acquisition itself if it is a `NewSurface`, otherwise `NewSurface()`."""
    return acquisition if isinstance(acquisition, NewSurface) else NewSurface()


@program
def seen_share(
    newness: Newness,
    surfaces: GridSurface,
    camera: Camera,
    poses: Pose,
    views: PoseList,
    barrier: Float[Array, "poses rays"] | None = None,
) -> Float[Array, ""]:
    """Return the fraction of the visible area that earlier views have seen; 1 if nothing is visible.

    The visible area is the part of the sampled surfaces that is visible from any of `poses`. A point has been seen if
    its newness is zero. For observations with `Looks`, the point must also be visible from an earlier view. Otherwise a
    point hidden behind an edge would count as seen because a point near it was measured.

    - `surfaces`: posterior samples, along a leading axis.
    - `views`: poses of the views so far.
    - `barrier`: distances to obstacles from `poses`, see `scan`.
    """
    areas = shared_map(_visible_areas, surfaces, newness, camera, poses, views, barrier)
    seen_area, visible_area = jnp.sum(areas, axis=0)
    return jnp.where(visible_area > 0, seen_area / jnp.where(visible_area > 0, visible_area, 1.0), 1.0)


def _visible_areas(
    surface: GridSurface,
    newness: Newness,
    camera: Camera,
    poses: Pose,
    views: PoseList,
    barrier: Float[Array, "poses rays"] | None,
) -> Float[Array, "2"]:
    """Return two areas of one sample: the visible area that has been seen, and the whole visible area."""
    points = spread_points(surface, _POINTS)
    tolerance = surface.grid.spacing
    is_in_view = jnp.any(is_visible(surface, camera, poses, points, tolerance, barrier), axis=0)
    is_seen = newness(points.points) <= 0
    if isinstance(newness.distances, Looks):
        is_in_earlier_view = is_visible(surface, newness.distances.camera, views.rows, points, tolerance)
        is_seen &= jnp.any(is_in_earlier_view & views.is_filled[:, None], axis=0)
    return jnp.stack([jnp.sum(points.areas, where=is_seen & is_in_view), jnp.sum(points.areas, where=is_in_view)])
