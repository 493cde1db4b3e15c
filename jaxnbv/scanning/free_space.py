"""Space that a sensor has seen to be empty, and carving: removal of sampled surface from this space.

Space is empty up to the hit of a ray, or along all of a ray that misses. An invalid ray shows nothing. A node of the
grid is *seen empty* if all rays near the node went past the node.
"""

import functools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxnbv.checks import check_fields, functions_of_users, own_settings, require
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.tensor_grid import on_tensor_grid
from jaxnbv.geometry.volume import Box, Volume
from jaxnbv.programs import program
from jaxnbv.scanning.grid import Grid

# Fraction of points that may lie more than two margins outside the volume. Noise moves fewer points that far.
_MAX_STRAY_FRACTION = 0.01


class Carving(eqx.Module):
    """Removal of sampled surface in space that was seen to be empty, and outside the object's volume.

    - `volume`: the region that can hold the object, see `jaxnbv.geometry.volume`. The default is the default `Box`.
    - `margin_voxels`: the margin, in spacings of the grid. A node is seen empty if every ray that passes the node
      within the margin, and every neighbour of such a ray in the image, stayed empty to at least the margin beyond the
      node. A node counts as outside if it lies more than two margins outside the volume.

    Because of the margin, a sheet thinner than a voxel keeps its surface when it is seen from both sides. Noise on hits
    does not remove surface if its standard deviation is below a third of the margin.

    **Raises:** `ValueError` if the margin is below half a voxel or not finite.
    """

    volume: Volume = Box()
    margin_voxels: float = eqx.field(static=True, default=1.0)

    @own_settings()
    def __check_init__(self):
        check_fields(self)
        require(
            0.5 <= self.margin_voxels < math.inf,
            f"the margin of the carving is {self.margin_voxels} voxels; it must be finite and at least 0.5",
        )
        with functions_of_users():
            values = jax.eval_shape(self.volume, jnp.zeros((2, 3)))
        require(
            getattr(values, "shape", None) == (2,) and jnp.issubdtype(values.dtype, jnp.floating),
            f"the volume returns {values} for two points; it must return one number per point",
        )

    def empty_nodes(
        self,
        grid: Grid,
        pose: Pose,
        scan: PointCloud,
        camera: Camera,
        barrier: Float[Array, " rays"] | None = None,
    ) -> Bool[Array, "g g g"]:
        """Return, for each node, whether one scan shows that the node is empty.

        No node counts as empty if the cloud is not a sensor's image (`missed` is None).

        - `barrier`: distance along each ray to the first obstacle, which ends the empty space of a ray without a hit.
        """
        if scan.missed is None:
            return jnp.zeros((grid.resolution,) * 3, bool)
        point_depth = jnp.matmul(scan.points - pose.position, pose.forward, precision="highest")
        limit = jnp.asarray(jnp.inf if camera.farthest is None else camera.farthest)
        if barrier is not None:
            limit = jnp.minimum(limit, barrier / jnp.linalg.norm(camera.pixel_directions(), axis=-1))
        depth = jnp.where(scan.mask, point_depth, jnp.where(scan.missed, limit, 0.0)).reshape(
            camera.height, camera.width
        )
        return _is_crossed(grid, depth, camera, pose, self.margin_voxels * grid.spacing)

    @program
    def outside(self, grid: Grid) -> Bool[Array, "g g g"]:
        """Return, for each node, whether it is more than two margins (`margin_voxels`) outside the volume."""
        return on_tensor_grid(self.volume, grid.axis) > self._beyond_volume(grid)

    def with_room(self, box: Box, grid: Grid, frame: Frame) -> Box:
        """Return a box (world) with all faces but the lower one moved outward by 2 / sqrt(3) margins.

        No corner moves by more than two margins. So if `box` lies in the volume, points in the result count as inside.
        A scan that is cropped to the result shows that the surface continues where `box` cuts it.
        """
        return frame.to_world(frame.to_scene(box).widened(self._beyond_volume(grid) / math.sqrt(3.0)))

    def _beyond_volume(self, grid: Grid) -> float:
        return 2.0 * self.margin_voxels * grid.spacing

    @program
    def inside(self, grid: Grid) -> Bool[Array, "g g g"]:
        """Return, for each node, whether it lies inside the volume."""
        return on_tensor_grid(self.volume, grid.axis) < 0

    def check_inside(self, cloud: PointCloud, grid: Grid) -> None:
        """Check that the volume, widened by two margins (`margin_voxels`), holds the cloud.

        **Raises:** `ValueError` if more than 1 % of the points lie outside, where carving would cut the object.
        """
        limit = self._beyond_volume(grid)
        num_outside, farthest = _count_outside(self.volume, cloud, limit)
        require(
            int(num_outside) <= _MAX_STRAY_FRACTION * int(cloud.count),
            f"{int(num_outside)} of {int(cloud.count)} scanned points lie up to {float(farthest):.4g} outside the "
            f"volume that is to hold the object ({self.volume}), more than {limit:.4g}: declare a larger one, "
            "Carving(Box(low, high)), drop points of other things, or bring the scan to scene coordinates with "
            "Frame.to_scene",
        )


@jax.jit
def carve(values: Float[Array, "*s g g g"], empty: Bool[Array, "g g g"]) -> Float[Array, "*s g g g"]:
    """Return node values (minus the level) in which all empty nodes are positive: outside the surface.

    The new value of an empty node is twice the largest magnitude among the node and its neighbours. So on the edge from
    an inside node to an empty node, the surface lies in the third of the edge next to the inside node.
    """
    magnitude = jnp.maximum(jnp.abs(values), jnp.finfo(values.dtype).tiny)
    for axis in (-3, -2, -1):
        window = [1] * values.ndim
        window[axis] = 3
        magnitude = jax.lax.reduce_window(magnitude, -jnp.inf, jax.lax.max, window, [1] * values.ndim, "SAME")
    return jnp.where(empty, 2.0 * magnitude, values)


@program
def _count_outside(volume: Volume, cloud: PointCloud, limit: float) -> tuple[Int[Array, ""], Float[Array, ""]]:
    # Evaluate all rows, so that clouds with different counts share a compilation.
    distances = jnp.where(cloud.mask, volume(cloud.points), -jnp.inf)
    # The comparison is negated so that NaN counts as outside.
    return jnp.sum(~(distances <= limit)), jnp.max(distances, initial=-jnp.inf)


def _is_crossed(
    grid: Grid, depth: Float[Array, "h w"], camera: Camera, pose: Pose, margin: float
) -> Bool[Array, "g g g"]:
    """Return, for each node, whether all rays near it stayed empty to at least `margin` beyond it.

    - `depth`: depth along the camera's axis up to which each pixel's ray was empty.
    - `margin`: a ray is near a node if it passes within this length of the node, in scene units.
    """
    # nearest[k] is the least depth within 2^k pixels of each pixel. Pixels beyond the border are ignored.
    nearest = [_least_within(depth, 1)]
    while 2 ** len(nearest) < max(depth.shape):
        nearest.append(_least_within(nearest[-1], 2 ** (len(nearest) - 1)))
    pyramid = jnp.stack(nearest)

    axis = jnp.asarray(grid.axis, depth.dtype)
    y, z = (plane.reshape(-1) for plane in jnp.meshgrid(axis, axis, indexing="ij"))

    def slab(x):
        nodes = jnp.stack([jnp.full_like(y, x), y, z], axis=-1)
        right, down, node_depth = jnp.matmul(nodes - pose.position, pose.rotation, precision="highest").T
        is_in_front = node_depth > 2.0 * margin
        safe_depth = jnp.where(is_in_front, node_depth, 1.0)
        a, b = right / safe_depth, down / safe_depth
        pixel = camera.to_pixels(jnp.stack([a, b], axis=-1)).T
        # The node must have rays on all sides.
        is_inside = (pixel >= 0.5) & (pixel <= jnp.array([[camera.width - 0.5], [camera.height - 0.5]]))
        column, row = jnp.floor(pixel).astype(jnp.int32)
        # The image of the ball of radius `margin` about the node lies within this radius, in pixels. The factor
        # 1 + a^2 + b^2 bounds how far it is stretched off the axis. One more pixel includes the rays on both sides.
        radius = max(camera.focal_lengths) * margin / (safe_depth - margin) * (1.0 + a**2 + b**2) + 1.0
        radius = jnp.ceil(radius)
        level = jnp.floor(jnp.log2(radius)).astype(jnp.int32)
        has_rays = is_in_front & is_inside.all(axis=0) & (level < len(nearest))
        level = jnp.where(has_rays, level, 0)
        # Four overlapping squares of half width 2^level <= radius cover the square of half width `radius`.
        shift = jnp.where(has_rays, radius.astype(jnp.int32) - 2**level, 0)
        corners = [
            pyramid[level, jnp.clip(row + down, 0, camera.height - 1), jnp.clip(column + across, 0, camera.width - 1)]
            for down in (-shift, shift)
            for across in (-shift, shift)
        ]
        least_depth = functools.reduce(jnp.minimum, corners)
        return (has_rays & (least_depth >= node_depth + margin)).reshape(grid.resolution, -1)

    return jax.lax.map(slab, axis)


def _least_within(image: Float[Array, "h w"], pixels: int) -> Float[Array, "h w"]:
    """Return, for each pixel, the minimum over a 3 x 3 pattern around it with a spacing of `pixels`."""
    for axis in (0, 1):
        pad = [(0, 0), (0, 0)]
        pad[axis] = (pixels, pixels)
        padded = jnp.pad(image, pad, constant_values=jnp.inf)
        size = image.shape[axis]
        shifted = [jax.lax.slice_in_dim(padded, start, start + size, axis=axis) for start in (0, pixels, 2 * pixels)]
        image = jnp.minimum(jnp.minimum(shifted[0], shifted[1]), shifted[2])
    return image
