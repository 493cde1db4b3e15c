"""Which surface the views so far have measured, and how far each of them saw.

D is thinned to its capacity, so what lies between its points may have been measured all the same. The hits of all rays
say what has been, at the resolution of the sensor. A sampled surface that a view must have seen and has not measured is
none that the sensor can measure: it is not there, or too dark, or too shiny.
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
from jaxnbv.scanning.grid import Grid, GridSurface
from jaxnbv.scanning.scanner import Surface, pixel_area, scan
from jaxnbv.sharding import shared_map

# In spacings of the grid: up to here distances to hits are kept.
_REACH = 3
STEEP = 0.5
"""The cosine of incidence below which little is expected: sensors measure little that is steeper, so that no look at it
is in vain, and imagined slopes are uncertain."""

# Of a view, at most: with more, imagining what it would have shown takes longer.
_RAYS = 5_000


class Looks(eqx.Module):
    """What the rays of all views came back with. Immutable and of fixed shapes.

    - `distance`: from each node of the grid to the nearest pixel on the surface, in scene units, at most `reach`.
    - `sight`: how far each view saw along the rays of `camera`, see `PointCloud`; zero beside its image.
    """

    distance: Float[Array, "g g g"]
    sight: Float[Array, "views rays"]
    camera: Camera
    grid: Grid

    @classmethod
    def none(cls, grid: Grid, camera: Camera, max_views: int) -> "Looks":
        """Before the first look. `camera`: the sensor, of whose rays those of every few rows and columns are kept."""
        camera = camera.strided(math.ceil(math.sqrt(camera.num_rays / _RAYS)))
        far = jnp.full((grid.resolution,) * 3, _REACH * grid.spacing, jnp.result_type(float))
        return cls(far, jnp.zeros((max_views, camera.num_rays), far.dtype), camera, grid)

    @property
    def reach(self) -> float:
        """The largest distance that is kept, in scene units."""
        return _REACH * self.grid.spacing

    @eqx.filter_jit
    def with_points(self, cloud: PointCloud, radii: Float[Array, " n"] | float = 0.0) -> "Looks":
        """The looks with a cloud's points as hits.

        - `radii`: how far each of them reaches, in scene units; a spacing of the grid at most counts.
        """
        radii = jnp.minimum(radii, self.grid.spacing)
        place = (cloud.points + self.grid.half_extent) / self.grid.spacing
        low = jnp.floor(place).astype(jnp.int32)

        def near(distance, offset):
            node = low + offset
            away = jnp.maximum(self.grid.spacing * jnp.linalg.norm(node - place, axis=-1) - radii, 0.0)
            # A negative index would count from the other end.
            there = cloud.mask & jnp.all(node >= 0, axis=-1)
            index = jnp.where(there[:, None], node, self.grid.resolution)
            return distance.at[tuple(index.T)].min(away, mode="drop"), None

        offsets = np.array(list(itertools.product(range(1 - _REACH, _REACH + 1), repeat=3)))
        return dataclasses.replace(self, distance=jax.lax.scan(near, self.distance, offsets)[0])

    def with_view(
        self,
        index: Int[Array, ""],
        pose: Pose,
        scan: PointCloud,
        camera: Camera,
        barrier: Float[Array, " rays"] | None = None,
    ) -> "Looks":
        """The looks with those of one view.

        - `index`: of the view, from 0; `camera`: the one that took it.
        - `barrier`: how far along each of its rays an obstacle stands; what is behind it was not looked at.
        """
        # Half the diagonal of a pixel on the surface: what lies between the rays of few pixels is not new.
        looks = self.with_points(scan, jnp.sqrt(jnp.maximum(0.5 * pixel_area(scan, camera, pose, STEEP), 0.0)))
        if scan.sight is None:
            return looks
        far = scan.sight if barrier is None else jnp.minimum(scan.sight, barrier)
        column, row = jnp.floor(camera.to_pixels(self.camera.pixel_directions()[:, :2])).astype(jnp.int32).T
        inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        sight = jnp.where(inside, far[jnp.where(inside, row * camera.width + column, 0)], 0.0)
        return dataclasses.replace(looks, sight=looks.sight.at[index].set(sight.astype(looks.sight.dtype)))

    def __call__(self, x: Float[Array, "*n 3"]) -> Float[Array, "*n"]:
        """Distance of points to the nearest hit, at most `reach`: linear between nodes, so that at a hit itself it is
        up to half a spacing. Differentiable in x."""
        places = list(jnp.moveaxis((x + self.grid.half_extent) / self.grid.spacing, -1, 0))
        return jax.scipy.ndimage.map_coordinates(self.distance, places, order=1, mode="nearest")

    @eqx.filter_jit
    def measurable(self, surfaces: GridSurface, poses: PoseList) -> GridSurface:
        """Sampled surfaces, along a leading axis, less what a view looked at and has not measured, and what lies within
        a cell of it: the view saw as far as the surface, which faces it, but no hit lies within a spacing.

        - `poses`: of the views.
        """
        return surfaces.void(shared_map(_looked_at_in_vain, surfaces, self, poses))

    def cells_in_vain(self, surface: Surface, index: Int[Array, ""] | int, pose: Pose) -> Int[Array, "rays 3"]:
        """The cells of the grid that hold what one view looked at of a surface and has not measured, see `measurable`;
        beyond the grid's cells for a ray that shows none.

        - `index`: of the view, from 0; `pose`: its own.
        """
        spacing = self.grid.spacing
        seen = scan(surface, self.camera, pose)
        offset = seen.points - pose.position
        away = jnp.linalg.norm(offset, axis=-1)
        cosine, sight = -jnp.sum(offset * seen.normals, axis=-1) / away, self.sight[index]
        # Steep ones need not return; but a ray that was met by something deeper has passed.
        passed = jnp.isfinite(sight) & ((sight - away) * cosine > spacing)
        in_vain = seen.mask & (passed | (cosine >= STEEP) & (away <= sight + spacing))
        in_vain &= self(seen.points) > spacing
        return jnp.where(in_vain[:, None], self.grid.cell_of(seen.points), self.grid.resolution)


def _looked_at_in_vain(surface: GridSurface, looks: Looks, poses: PoseList) -> Bool[Array, "m m m"]:
    def look(index, found):
        cells = looks.cells_in_vain(surface, index, jax.tree.map(lambda rows: rows[index], poses.rows))
        return found.at[tuple(cells.T)].set(True, mode="drop")

    found = jax.lax.fori_loop(0, poses.count, look, jnp.zeros(surface.distance.shape, bool))
    # Rays are farther apart than cells.
    for axis in range(3):
        window = tuple(3 if own == axis else 1 for own in range(3))
        found = jax.lax.reduce_window(found, False, jax.lax.bitwise_or, window, (1, 1, 1), "SAME")
    return found
