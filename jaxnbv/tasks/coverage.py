"""Coverage: how much of the surface has been seen, and how much more a view would show."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxnbv.acquisition import Acquisition, ImaginedView
from jaxnbv.checks import check_fields, require
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.neighbours import DistanceField, nearest_squared_distance, spacing
from jaxnbv.geometry.pose import Pose
from jaxnbv.sampler import StepInputs
from jaxnbv.scanning import Grid, GridSurface, Looks, Surface, pixel_area, scan
from jaxnbv.scanning.looks import STEEP
from jaxnbv.scanning.metrics import GRAZING
from jaxnbv.sharding import on_cpu, shared_map
from jaxnbv.utility import Quantity

# Scene units: s without looks.
_SIZE = 0.05


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
    barrier: Float[Array, "poses rays"] | None = None,
) -> Float[Array, ""]:
    """The share of what a camera can see of the sampled surfaces from some poses together that is not new: of the cells
    of their grid, each of which counts once, however many poses see it.

    - `barrier`: see `scan`.
    """
    counts = shared_map(cells_shown, surfaces, unseen, surfaces.grid, camera, poses, barrier)
    new, shown = jnp.sum(counts, axis=0)
    return 1.0 - new / jnp.maximum(shown, 1)


def cells_shown(
    surface: Surface,
    unseen: Unseen,
    grid: Grid,
    camera: Camera,
    poses: Pose,
    barrier: Float[Array, "poses rays"] | None = None,
) -> Int[Array, "2"]:
    """How many cells of a grid hold surface that some poses show and that is new; and how many hold any that they show,
    but at a grazing angle."""
    scans = scan(surface, camera, poses, barrier)
    offset = scans.points - poses.position[:, None]
    cosine = jnp.abs(jnp.sum(offset * scans.normals, axis=-1)) / jnp.linalg.norm(offset, axis=-1)
    points, measured = scans.points.reshape(-1, 3), (scans.mask & (cosine >= GRAZING)).reshape(-1)

    def number(kept):
        cell = jnp.where(kept[:, None], grid.cell_of(points), grid.resolution)
        found = jnp.zeros((grid.resolution,) * 3, bool).at[tuple(cell.T)].set(True, mode="drop")
        return jnp.sum(found)

    return jnp.stack([number(measured & (unseen(points) > 0)), number(measured)])
