"""Coverage: how much of the surface has been seen, and how much more a view would show."""

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
from jaxnbv.sampler import StepInputs
from jaxnbv.scanning import GridSurface, Looks, pixel_area
from jaxnbv.scanning.looks import STEEP
from jaxnbv.scanning.visibility import sees, spread_points
from jaxnbv.sharding import on_cpu, shared_map
from jaxnbv.utility import Quantity

# Scene units: s without looks.
_SIZE = 0.05
# By which the share that was seen is told, of each sample: to a percent.
_POINTS = 1024


def _many() -> int:
    """Scans at once, where little is computed of each."""
    return 128 if on_cpu() else 2048


class Coverage(Acquisition):
    """The paper's alpha^(CD): sum over the points x of the scan of min_{y in D} |x - y|^2, in squared scene units."""

    def context(self, step: StepInputs) -> PointCloud:
        """D itself."""
        return step.observations.cloud

    def score(self, context: PointCloud, view: ImaginedView) -> Float[Array, ""]:
        """Unidirectional Chamfer distance from the scan to D; zero for a scan that sees nothing."""
        return jnp.sum(jnp.where(view.scan.mask, nearest_squared_distance(view.scan.points, context), 0.0))

    @property
    def quantity(self) -> Quantity:
        meaning = "squared distances to the cloud, summed over an imagined scan, mean over posterior samples."
        return Quantity("expected coverage gain", "", meaning, length_power=2)

    @property
    def batch_size(self) -> int:
        """Many scans at once: the loop over D runs once for all of them."""
        return _many()


class Unseen(eqx.Module):
    """Where surface would be new, given what has been observed.

    - `seen`: distances to all that was measured, or to D where looks are not kept; `size`: see `NewSurface`.
    """

    seen: Looks | DistanceField
    size: Float[Array, ""]

    def __call__(self, points: Float[Array, "n 3"]) -> Float[Array, " n"]:
        """How new surface at some points is, from 0 to 1."""
        return jnp.clip(self.seen(points) / self.size - 1.0, 0.0, 1.0)


class NewSurface(Acquisition):
    """Expected new area: how much surface an imagined scan shows that was not measured yet, in squared scene units.

        alpha(D, scan) = sum_x a(x) clip(d(x) / s - 1, 0, 1)

    over the hits x of the scan, where d is the distance to the nearest pixel of any view so far, as large as it is on
    the surface (`Looks`), and a(x) = r^2 omega / cos the area of the pixel on the surface: omega its solid angle, r the
    distance, cos that of the angle of incidence, at least 0.5. The rays of one scan do not overlap, so no part of the
    surface counts twice; and neither near surfaces, which fill more pixels, nor a single point far from all others
    outweighs the rest, as in the paper's `Coverage`. It is differentiable in the pose wherever `Coverage` is, but its
    derivative lacks the jumps that make most of a gain: search over candidates.

    - `size`: s, what lies within this distance of a hit has been seen; what is twice as far is new. In scene units, in
      a session too; by default, and at least, the spacing of the grid on which looks are kept.

    Observations that keep no looks, such as a cloud alone, have D in place of all hits; then s is 0.05 by default, and
    at least the median of how far points of D are from their nearest neighbours.

    **Raises:** `ValueError` if the size is not positive.
    """

    size: float | None = eqx.field(static=True, default=None)
    measurable_only: ClassVar[bool] = True
    gains_once: ClassVar[bool] = True

    def __check_init__(self):
        check_fields(self)
        require(self.size is None or self.size > 0, f"the size is {self.size}; it must be positive, in scene units")

    def context(self, step: StepInputs) -> Unseen:
        """What has been seen."""
        cloud, looks = step.observations.cloud, step.observations.looks
        if looks is not None and 2.0 * (self.size or 0.0) <= looks.reach:
            return Unseen(looks, jnp.asarray(max(looks.grid.spacing, self.size or 0.0), cloud.points.dtype))
        size = jnp.maximum(_SIZE if self.size is None else self.size, spacing(cloud))
        return Unseen(DistanceField.of(cloud, 2.0 * size), size)

    def score(self, context: Unseen, view: ImaginedView) -> Float[Array, ""]:
        """The new area of one scan; zero for a scan that sees nothing."""
        return jnp.sum(pixel_area(view.scan, view.camera, view.pose, STEEP) * context(view.scan.points))

    @property
    def quantity(self) -> Quantity:
        meaning = "area that an imagined scan shows and no scan has shown before, mean over posterior samples."
        return Quantity("expected new area", "", meaning, length_power=2)

    @property
    def batch_size(self) -> int:
        """Many scans at once."""
        return _many()


def newness_of(acquisition: Acquisition) -> NewSurface:
    """What counts as new to an acquisition: itself, if it looks for new surface, or the default."""
    return acquisition if isinstance(acquisition, NewSurface) else NewSurface()


@eqx.filter_jit
def seen_share(
    unseen: Unseen,
    surfaces: GridSurface,
    camera: Camera,
    poses: Pose,
    taken: PoseList,
    barrier: Float[Array, "poses rays"] | None = None,
) -> Float[Array, ""]:
    """The share, by area, that has been seen of what a camera sees of the sampled surfaces from some poses together.
    A point has been seen if it is not new and, where looks are kept, a view that was taken shows it: what is near to
    what was measured may lie round an edge.

    - `taken`: where views were taken.
    - `barrier`: of `poses`, see `scan`.
    """
    areas = shared_map(_areas_shown, surfaces, unseen, camera, poses, taken, barrier)
    seen, shown = jnp.sum(areas, axis=0)
    return jnp.where(shown > 0, seen / jnp.where(shown > 0, shown, 1.0), 1.0)


def _areas_shown(
    surface: GridSurface,
    unseen: Unseen,
    camera: Camera,
    poses: Pose,
    taken: PoseList,
    barrier: Float[Array, "poses rays"] | None,
) -> Float[Array, "2"]:
    """The area of one sample that was seen, and that the poses show."""
    points = spread_points(surface, _POINTS)
    tolerance = surface.grid.spacing
    shown = jnp.any(sees(surface, camera, poses, points, tolerance, barrier), axis=0)
    seen = unseen(points.points) <= 0
    if isinstance(unseen.seen, Looks):
        own = sees(surface, unseen.seen.camera, taken.rows, points, tolerance)
        seen &= jnp.any(own & taken.is_filled[:, None], axis=0)
    return jnp.stack([jnp.sum(points.areas, where=seen & shown), jnp.sum(points.areas, where=shown)])
