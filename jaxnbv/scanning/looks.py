"""The surface that earlier views have measured, and how far each view saw.

The observed cloud is thinned, so surface between its points may have been measured too. This module instead uses the
hits of all rays. If a view should have seen a sampled surface but did not measure it, later views will not measure it
either: the surface does not exist, or it is too dark or too shiny for the sensor.
"""

import dataclasses
import itertools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.pose_list import PoseList
from jaxnbv.programs import program
from jaxnbv.scanning.grid import Grid, GridSurface
from jaxnbv.scanning.scanner import Surface, pixel_area, scan
from jaxnbv.sharding import shared_map

# Largest stored distance to a hit, in spacings of the grid.
_MAX_DISTANCE = 3
STEEP = 0.5
"""The cosine of incidence below which a surface counts as steep. Sensors measure little of a steep surface, so a
missing hit on it proves nothing. The slopes of samples are also uncertain."""

# Largest number of rays that is stored for a view. More rays would slow down the scans of sampled surfaces.
_MAX_RAYS = 5_000


class Looks(eqx.Module):
    """The measured surface and the lines of sight of all views. Immutable, with fixed shapes.

    - `distance`: distance from each node to the nearest measured surface, in scene units, at most `reach`.
    - `sight`: distance that each view measured along each ray of `camera`, in scene units; infinite if it measured
      none, and zero for a ray outside the image of the view.
    - `camera`: a copy of the sensor's camera with only every k-th row and column, to limit the number of rays.
    """

    distance: Float[Array, "g g g"]
    sight: Float[Array, "views rays"]
    camera: Camera
    grid: Grid

    @classmethod
    def empty(cls, grid: Grid, camera: Camera, max_views: int) -> "Looks":
        """Return a `Looks` with room for `max_views` views of the sensor's camera."""
        camera = camera.strided(math.ceil(math.sqrt(camera.num_rays / _MAX_RAYS)))
        far = jnp.full((grid.resolution,) * 3, _MAX_DISTANCE * grid.spacing, jnp.result_type(float))
        return cls(far, jnp.zeros((max_views, camera.num_rays), far.dtype), camera, grid)

    @property
    def reach(self) -> float:
        """The largest value of `distance`, in scene units."""
        return _MAX_DISTANCE * self.grid.spacing

    @program
    def with_points(self, cloud: PointCloud, radii: Float[Array, " n"] | float = 0.0) -> "Looks":
        """Return a copy with the points of a cloud added to the measured surface.

        - `radii`: radius around each point within which surface counts as measured, in scene units, clipped to the
          grid's spacing.
        """
        radii = jnp.minimum(radii, self.grid.spacing)
        position = (cloud.points + self.grid.half_extent) / self.grid.spacing
        low = jnp.floor(position).astype(jnp.int32)

        def add_offset(distance, offset):
            node = low + offset
            to_point = jnp.maximum(self.grid.spacing * jnp.linalg.norm(node - position, axis=-1) - radii, 0.0)
            # JAX would count a negative index from the other end, so such rows get an index beyond the grid.
            is_node = cloud.mask & jnp.all(node >= 0, axis=-1)
            index = jnp.where(is_node[:, None], node, self.grid.resolution)
            return distance.at[tuple(index.T)].min(to_point, mode="drop"), None

        offsets = np.array(list(itertools.product(range(1 - _MAX_DISTANCE, _MAX_DISTANCE + 1), repeat=3)))
        return dataclasses.replace(self, distance=jax.lax.scan(add_offset, self.distance, offsets)[0])

    def with_view(
        self,
        index: Int[Array, ""],
        pose: Pose,
        scan: PointCloud,
        camera: Camera,
        barrier: Float[Array, " rays"] | None = None,
    ) -> "Looks":
        """Return a copy with one more view.

        - `index`: index of the view, from 0.
        - `barrier`: distance along each ray of `camera` to the first obstacle. The view saw nothing behind it.
        """
        # The radius is half the diagonal of a pixel on the surface, so that surface between the rays of a coarse image
        # counts as measured.
        looks = self.with_points(scan, jnp.sqrt(jnp.maximum(0.5 * pixel_area(scan, camera, pose, STEEP), 0.0)))
        if scan.sight is None:
            return looks
        max_sight = scan.sight if barrier is None else jnp.minimum(scan.sight, barrier)
        column, row = jnp.floor(camera.to_pixels(self.camera.pixel_directions()[:, :2])).astype(jnp.int32).T
        is_inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        sight = jnp.where(is_inside, max_sight[jnp.where(is_inside, row * camera.width + column, 0)], 0.0)
        return dataclasses.replace(looks, sight=looks.sight.at[index].set(sight.astype(looks.sight.dtype)))

    def __call__(self, x: Float[Array, "*n 3"]) -> Float[Array, "*n"]:
        """Return the distance from each point x to the nearest measured surface, in scene units.

        Distances are at most `reach`, and interpolated linearly between the nodes. So on a measured surface the result
        is not zero, but up to half the spacing of the nodes. Differentiable in x (scene coordinates).
        """
        positions = list(jnp.moveaxis((x + self.grid.half_extent) / self.grid.spacing, -1, 0))
        return jax.scipy.ndimage.map_coordinates(self.distance, positions, order=1, mode="nearest")

    @program
    def without_unmeasured(self, surfaces: GridSurface, poses: PoseList) -> GridSurface:
        """Return a batch of surfaces without the `unmeasured_cells` of any view and without adjacent cells."""
        return surfaces.without_cells(shared_map(_unmeasured_by_any, surfaces, self, poses))

    def unmeasured_cells(self, surface: Surface, index: Int[Array, ""] | int, pose: Pose) -> Int[Array, "rays 3"]:
        """Return, for each ray of a view, the cell of its hit on a surface if the hit is unmeasured.

        A hit is unmeasured if the view should have measured it, but no measured surface is within one grid spacing of
        it. The view should have measured a hit if the surface is not steep there and the view saw as far as the hit, or
        if the view measured something deeper on the same ray. All other rays get an index beyond the grid.

        - `index`, `pose`: index of the view, from 0, and its pose.
        """
        spacing = self.grid.spacing
        hits = scan(surface, self.camera, pose)
        offset = hits.points - pose.position
        distance = jnp.linalg.norm(offset, axis=-1)
        cosine, sight = -jnp.sum(offset * hits.normals, axis=-1) / distance, self.sight[index]
        # A steep surface may give no measurement. But if the view measured something deeper, there is no surface here.
        is_passed = jnp.isfinite(sight) & ((sight - distance) * cosine > spacing)
        is_unmeasured = hits.mask & (is_passed | (cosine >= STEEP) & (distance <= sight + spacing))
        is_unmeasured &= self(hits.points) > spacing
        return jnp.where(is_unmeasured[:, None], self.grid.cell_of(hits.points), self.grid.resolution)


def _unmeasured_by_any(surface: GridSurface, looks: Looks, poses: PoseList) -> Bool[Array, "m m m"]:
    def mark(index, is_unmeasured):
        cells = looks.unmeasured_cells(surface, index, poses.rows[index])
        return is_unmeasured.at[tuple(cells.T)].set(True, mode="drop")

    is_unmeasured = jax.lax.fori_loop(0, poses.count, mark, jnp.zeros(surface.distance.shape, bool))
    # Include neighbouring cells, since the distance between rays can exceed the size of a cell.
    for axis in range(3):
        window = tuple(3 if other == axis else 1 for other in range(3))
        is_unmeasured = jax.lax.reduce_window(is_unmeasured, False, jax.lax.bitwise_or, window, (1, 1, 1), "SAME")
    return is_unmeasured
