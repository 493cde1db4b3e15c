"""`GridSurface`, the level set of a function on a regular grid, such as a posterior sample."""

import dataclasses
import warnings
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Int8
from scipy.spatial import cKDTree

from jaxnbv.checks import AnyArray, as_floats, check_fields, is_traced, require
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose
from jaxnbv.programs import program
from jaxnbv.scanning import tracing
from jaxnbv.scanning.scanner import Hits, Surface, scan
from jaxnbv.sharding import on_cpu, shared_map

# Two normals count as opposite if the cosine between them is below `_MAX_OPPOSITE_COSINE`. `Grid.check` warns if more
# than the fraction `_MAX_THIN_FRACTION` of the points lies on thin parts.
_MAX_OPPOSITE_COSINE, _MAX_THIN_FRACTION = -0.8, 0.05


class Grid(eqx.Module):
    """A regular grid of `resolution`^3 nodes that spans [-half_extent, half_extent]^3 of the scene.

    The defaults are the paper's: 100^3 nodes on [-1.75, 1.75]^3. Samples may miss a part of the object that is thinner
    than a cell (`spacing`) and lies between nodes. Use a finer grid for thin parts.
    """

    resolution: int = eqx.field(static=True, default=100)
    half_extent: float = eqx.field(static=True, default=1.75)

    def __check_init__(self):
        check_fields(self)
        require(self.resolution >= 4, f"a grid of {self.resolution}^3 nodes is too small; it needs at least 4^3")
        require(self.half_extent > 0, f"the grid's half extent is {self.half_extent}; it must be positive")

    @property
    def spacing(self) -> float:
        """Distance between neighbouring nodes, in scene units."""
        return 2.0 * self.half_extent / (self.resolution - 1)

    def cell_of(self, points: Float[Array, "*n 3"]) -> Int[Array, "*n 3"]:
        """Return the index of the cell that holds each point (scene coordinates).

        Along each axis, cell i lies between the nodes i and i + 1, for i from 0 to `resolution - 2`. A point outside
        the grid has at least one larger index. No index is negative, because JAX would count it from the end.
        """
        cell = jnp.floor((points + self.half_extent) / self.spacing).astype(jnp.int32)
        return jnp.where(cell < 0, self.resolution, cell)

    def check(self, cloud: PointCloud) -> None:
        """Warn if the cloud has many points on parts thinner than a cell, which samples may miss.

        A point is on a thin part if a point with an opposite normal is less than a cell's width away.
        """
        points, normals = cloud.to_numpy()
        pairs = cKDTree(points).query_pairs(self.spacing, output_type="ndarray")
        is_opposite = np.sum(normals[pairs[:, 0]] * normals[pairs[:, 1]], axis=1) < _MAX_OPPOSITE_COSINE
        num_thin = len(np.unique(pairs[is_opposite]))
        if num_thin > _MAX_THIN_FRACTION * len(points):
            warnings.warn(
                f"{num_thin} of {len(points)} points lie on parts thinner than a cell of the grid, {self.spacing:.3g} "
                "scene units: some samples will miss these. Raise Grid(resolution=...)",
                stacklevel=3,
            )

    @property
    def axis(self) -> Float[np.ndarray, " g"]:
        """Coordinates of the nodes along one axis."""
        return np.linspace(-self.half_extent, self.half_extent, self.resolution)


class GridSurface(Surface):
    """The zero set of a trilinear interpolant of node values, or a batch of zero sets along leading axes.

    Rays are traced exactly, and hit nothing outside the grid's box.

    - `values`: values of a function f at the nodes, minus the level of f on the surface; positive outside the solid.
    - `distance`: distance from each cell to the nearest change of sign of the values, see `tracing.free_distance`.
    - `is_void`: whether each cell counts as free of surface. A ray whose first zero is in such a cell misses.
    """

    in_jit: ClassVar[bool] = True

    values: Float[Array, "*s g g g"]
    distance: Int8[Array, "*s m m m"]
    grid: Grid
    is_void: Bool[Array, "*s m m m"] | None = None

    @classmethod
    def from_values(
        cls, values: Float[AnyArray, "*s g g g"], level: Float[AnyArray, ""] | float, grid: Grid
    ) -> "GridSurface":
        """Return the surface where node values equal `level`, or a batch of surfaces for leading axes.

        **Raises:** `ValueError` if the values do not fit the grid, or if a value or the level is not finite.
        """
        g = grid.resolution
        values, level = as_floats(values, "the values"), as_floats(level, "the level")
        require(
            values.shape[-3:] == (g, g, g),
            f"values of shape {values.shape} do not fit a grid of {g}^3 nodes: evaluate with x, y and z on grid.axis",
        )
        relative, is_finite, distances = _prepare(values, level)
        if not is_traced(is_finite):
            require(bool(is_finite), "the values on the grid, or the level, are not finite")
        return cls(relative, distances, grid)

    def without_cells(self, cells: Bool[Array, "*s m m m"]) -> "GridSurface":
        """Return the surface without its parts in cells that are True. Rays that would hit these parts miss."""
        return dataclasses.replace(self, is_void=cells if self.is_void is None else self.is_void | cells)

    @program
    def trace(self, origins: Float[AnyArray, "rays 3"], directions: Float[AnyArray, "rays 3"]) -> Hits:
        """Return the first zeros along the rays inside the grid's box; see `Surface.trace`.

        A ray starts at its origin or, if the origin is outside the box, where the ray enters the box. The hit is the
        first point at which the sign of the interpolant differs from its sign at the start. Zero counts as negative.
        Normals are central differences at the nodes, interpolated linearly, so they are continuous.

        Hits are differentiable in origins o, directions d and values f. At a hit o + t d the implicit function theorem
        gives dt = -(df + grad f . dx) / (grad f . d), with dx = do + t dd. The denominator is kept away from zero for
        grazing rays, so |dt| is at most about 34 |dx| if f is fixed.

        **Raises:** `ValueError` for a batch of surfaces.
        """
        require(
            self.values.ndim == 3,
            f"rays are traced through one surface, not a batch of shape {self.values.shape[:-3]}: use scan_samples",
        )
        h, half = self.grid.spacing, self.grid.half_extent
        field = tracing.GridField(self.values.reshape(-1), self.distance.reshape(-1), self.grid.resolution)
        o, d = list(jnp.asarray(origins).T), list(jnp.asarray(directions).T)
        t, mask = tracing.first_zero(field, [(x + half) / h for x in o], [x / h for x in d])
        if self.is_void is not None:
            cells = [jnp.floor((x + t * dx + half) / h).astype(jnp.int32) for x, dx in zip(o, d, strict=True)]
            mask = mask & ~self.is_void[tuple(jnp.clip(cell, 0, self.grid.resolution - 2) for cell in cells)]
        hits = [jnp.where(mask, x + t * dx, 0.0) for x, dx in zip(o, d, strict=True)]

        normals = tracing.smooth_gradient(field, [(x + half) / h for x in hits])
        facing = -jnp.sign(sum(n * dx for n, dx in zip(normals, d, strict=True)))
        square = sum(n * n for n in normals)
        is_valid = mask & (square > 0)
        scale = jnp.where(
            is_valid, jnp.where(facing == 0, 1.0, facing) / jnp.sqrt(jnp.where(is_valid, square, 1.0)), 0.0
        )
        return Hits(jnp.stack(hits, axis=-1), jnp.stack([n * scale for n in normals], axis=-1), mask)


@program
def scan_samples(
    surfaces: GridSurface, camera: Camera, poses: Pose, barrier: Float[Array, "poses rays"] | None = None
) -> PointCloud:
    """Scan each surface of a batch from each pose of a batch. Leading axes are (surfaces, poses)."""
    return shared_map(scan, surfaces, camera, poses, barrier, at_once=samples_at_once(camera, poses))


def samples_at_once(camera: Camera, poses: Pose) -> int:
    """Return the number of sampled surfaces to scan together from a batch of poses.

    On a CPU it is one, so that the scans of a sample stay in the cache. On a GPU it is as large as 8e6 rays allow.
    """
    return 1 if on_cpu() else max(1, 2**23 // (poses.position.shape[0] * camera.num_rays))


@jax.debug_nans(False)
@program
def mean_depth(scans: PointCloud, pose: Pose) -> Float[Array, " rays"]:
    """Return the mean depth at which each ray hits the samples; NaN if it misses more than half of them.

    - `scans`: scans of all samples (leading axis) from the same pose.
    """
    depth = jnp.einsum("snd,d->sn", scans.points - pose.position, pose.forward, precision="highest")
    count = jnp.sum(scans.mask, axis=0)
    mean = jnp.sum(jnp.where(scans.mask, depth, 0.0), axis=0) / jnp.maximum(count, 1)
    return jnp.where(2 * count >= scans.mask.shape[0], mean, jnp.nan)


@jax.jit
def _prepare(
    values: Float[Array, "*s g g g"], level: Float[Array, ""]
) -> tuple[Float[Array, "*s g g g"], Bool[Array, ""], Int8[Array, "*s m m m"]]:
    values = values - level
    distances = shared_map(tracing.free_distance, values.reshape(-1, *values.shape[-3:]))
    return values, jnp.isfinite(values).all(), distances.reshape(*values.shape[:-3], *distances.shape[1:])


def touched_cells(nodes: Bool[Array, "*s g g g"]) -> Bool[Array, "*s m m m"]:
    """Return, for each cell of a grid, whether `nodes` is True at any corner of the cell."""
    windows = (1,) * (nodes.ndim - 3) + (2,) * 3, (1,) * nodes.ndim
    return jax.lax.reduce_window(nodes, False, jax.lax.bitwise_or, *windows, "VALID")
