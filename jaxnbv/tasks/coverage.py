"""Coverage: acquisitions for new surface, and the share of the surface that has been seen."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxnbv.acquisition import Acquisition, ImaginedView
from jaxnbv.checks import check_fields, require
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.neighbours import DistanceField, nearest_squared_distance, spacing
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.pose_list import PoseList
from jaxnbv.programs import program
from jaxnbv.sampler import StepInputs
from jaxnbv.scanning import GridSurface, Looks, pixel_area
from jaxnbv.scanning.looks import STEEP
from jaxnbv.scanning.visibility import is_visible, spread_points
from jaxnbv.sharding import on_cpu, shared_map
from jaxnbv.utility import Quantity

# Default s without looks, in scene units.
_SIZE = 0.05
# Points on each sample for the seen share, which is then accurate to a percent.
_POINTS = 1024


def _many() -> int:
    """Batch size of scans with a cheap score."""
    return 128 if on_cpu() else 2048


class Coverage(Acquisition):
    """Chamfer distance from scan to D, sum_{x in scan} min_{y in D} |x - y|^2, in squared scene units.

    The paper's alpha^(CD).
    """

    def context(self, step: StepInputs) -> PointCloud:
        """D itself."""
        return step.observations.cloud

    def score(self, context: PointCloud, view: ImaginedView) -> Float[Array, ""]:
        """Unidirectional Chamfer distance from the scan to D. Zero for an empty scan."""
        return jnp.sum(jnp.where(view.scan.mask, nearest_squared_distance(view.scan.points, context), 0.0))

    @property
    def quantity(self) -> Quantity:
        meaning = "squared distances to the cloud, summed over an imagined scan, mean over posterior samples."
        return Quantity("expected coverage gain", "", meaning, length_power=2)

    @property
    def batch_size(self) -> int:
        """Many scans at once, since a single loop over D serves all of them."""
        return _many()


class Newness(eqx.Module):
    """How new a point on a surface is, given the observations.

    - `distances`: distance field to all hits of earlier views, or to D if the observations keep no looks.
    - `size`: see `NewSurface`.
    """

    distances: Looks | DistanceField
    size: Float[Array, ""]

    def __call__(self, points: Float[Array, "n 3"]) -> Float[Array, " n"]:
        """Newness of surface at each point, from 0 to 1."""
        return jnp.clip(self.distances(points) / self.size - 1.0, 0.0, 1.0)


class NewSurface(Acquisition):
    """Area in an imagined scan that no view has measured yet, in squared scene units.

        alpha(D, scan) = sum_x a(x) clip(d(x) / s - 1, 0, 1)

    over the hits x of the scan. d is the distance to the nearest pixel footprint of any earlier view (`Looks`), and
    a(x) = r^2 omega / cos is the pixel's area on the surface: omega its solid angle, r the distance, and cos the cosine
    of the angle of incidence, at least 0.5. Rays of one scan do not overlap, so no surface counts twice. In the paper's
    `Coverage` near surfaces, which fill more pixels, or a single far point can outweigh the rest. Here they cannot. It
    is differentiable in the pose wherever `Coverage` is, but most of a gain comes from jumps, which the derivative
    misses: search over candidates.

    - `size`: s. Surface within s of a hit has been seen, and surface farther than 2 s is new. In scene units, also in
      sessions. The spacing of the grid of `Looks` is both the default and the minimum.

    Observations without looks, such as a cloud alone, use D in place of all hits. Then s is 0.05 by default, and at
    least the median distance from points of D to their nearest neighbours.

    **Raises:** `ValueError` if the size is not positive.
    """

    size: float | None = eqx.field(static=True, default=None)
    measurable_only: ClassVar[bool] = True
    gains_once: ClassVar[bool] = True

    def __check_init__(self):
        check_fields(self)
        require(self.size is None or self.size > 0, f"the size is {self.size}; it must be positive, in scene units")

    def context(self, step: StepInputs) -> Newness:
        """The newness of points, from the looks or from D."""
        cloud, looks = step.observations.cloud, step.observations.looks
        if looks is not None and 2.0 * (self.size or 0.0) <= looks.reach:
            return Newness(looks, jnp.asarray(max(looks.grid.spacing, self.size or 0.0), cloud.points.dtype))
        size = jnp.maximum(_SIZE if self.size is None else self.size, spacing(cloud))
        return Newness(DistanceField.of(cloud, 2.0 * size), size)

    def score(self, context: Newness, view: ImaginedView) -> Float[Array, ""]:
        """New area of one scan. Zero for an empty scan."""
        return jnp.sum(pixel_area(view.scan, view.camera, view.pose, STEEP) * context(view.scan.points))

    @property
    def quantity(self) -> Quantity:
        meaning = "area that an imagined scan shows and no scan has shown before, mean over posterior samples."
        return Quantity("expected new area", "", meaning, length_power=2)

    @property
    def batch_size(self) -> int:
        """Many scans at once, since the score is cheap."""
        return _many()


def new_surface_of(acquisition: Acquisition) -> NewSurface:
    """The acquisition itself if it is a `NewSurface`, else the default one."""
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
    """Share of the area visible from `poses` on the sampled surfaces that earlier views have seen.

    A point has been seen if it is not new and, if the observations keep looks, is visible from the pose of a view. A
    point near to a measured one may still be hidden behind an edge.

    - `views`: poses of the views so far.
    - `barrier`: distances to obstacles from `poses`, see `scan`.
    """
    areas = shared_map(_areas_shown, surfaces, newness, camera, poses, views, barrier)
    seen_area, visible_area = jnp.sum(areas, axis=0)
    return jnp.where(visible_area > 0, seen_area / jnp.where(visible_area > 0, visible_area, 1.0), 1.0)


def _areas_shown(
    surface: GridSurface,
    newness: Newness,
    camera: Camera,
    poses: Pose,
    views: PoseList,
    barrier: Float[Array, "poses rays"] | None,
) -> Float[Array, "2"]:
    """Two areas of one sample: visible from the poses and already seen, and visible from the poses."""
    points = spread_points(surface, _POINTS)
    tolerance = surface.grid.spacing
    is_shown = jnp.any(is_visible(surface, camera, poses, points, tolerance, barrier), axis=0)
    is_seen = newness(points.points) <= 0
    if isinstance(newness.distances, Looks):
        own = is_visible(surface, newness.distances.camera, views.rows, points, tolerance)
        is_seen &= jnp.any(own & views.is_filled[:, None], axis=0)
    return jnp.stack([jnp.sum(points.areas, where=is_seen & is_shown), jnp.sum(points.areas, where=is_shown)])
