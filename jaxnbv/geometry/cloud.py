"""Point clouds with normals, in arrays with a fixed number of rows."""

import functools
import warnings
from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Real

from jaxnbv.checks import (
    AnyArray,
    as_numbers,
    check_batch,
    check_index,
    check_type,
    checked,
    native,
    own_settings,
    require,
    short_text,
)
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.depth_image import points_of_depth
from jaxnbv.geometry.farthest_points import farthest_point_indices
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.volume import Box

# Largest number of rows that a 32-bit index can count, far more than fit in memory.
_MAX_ROWS = 2**31 - 1
_MAX_NORMAL_LENGTH = 10.0


class PointCloud(eqx.Module):
    """Points with normals (the paper's cloud D), in arrays with a fixed number of rows.

    The number of rows is the cloud's capacity. A row is filled if its mask is True. Else it is empty, and its point and
    normal are zero. Leading axes make a batch of clouds.

    - `points`: positions, in scene units unless stated otherwise.
    - `normals`: unit outward normals.
    - `mask`: whether each row holds a point.
    - `missed`: whether each ray met nothing, so that the space along it is empty. Only a sensor's scan, which has one
      row per pixel, has this array; other clouds have None. A row that is neither filled nor missed is invalid.
    - `sight`: distance that the camera measured along each ray of a scan, in units of the points; infinite if it
      measured none. The hit need not be a point of the cloud. None if unknown.
    """

    points: Float[Array, "*batch n 3"] = eqx.field(converter=native)
    normals: Float[Array, "*batch n 3"] = eqx.field(converter=native)
    mask: Bool[Array, "*batch n"]
    missed: Bool[Array, "*batch n"] | None = None
    sight: Float[Array, "*batch n"] | None = eqx.field(converter=native, default=None)

    def __check_init__(self):
        leaves = self.points, self.normals, self.mask, self.missed, self.sight
        shapes = [jnp.shape(leaf) for leaf in leaves if leaf is not None]
        rows = shapes[0][:-1]
        require(
            len(rows) > 0 and shapes[0] == shapes[1] == (*rows, 3) and all(shape == rows for shape in shapes[2:]),
            f"a cloud needs points and normals (..., n, 3) and masks (..., n), got {shapes}: build it with "
            "PointCloud.from_arrays",
        )
        for leaf, name in ((self.mask, "mask"), (self.missed, "missed")):
            require(leaf is None or leaf.dtype == bool, f"a cloud's {name} is {short_text(leaf)}: give a boolean array")

    @classmethod
    @own_settings()
    def from_arrays(
        cls,
        points: Float[AnyArray, "n 3"] | list,
        normals: Float[AnyArray, "n 3"] | list,
        capacity: int | None = None,
    ) -> "PointCloud":
        """Build a cloud from points and outward normals, padded to `capacity` rows (by default, not padded).

        Normals are scaled to unit length, with a `UserWarning` if the length of one changes by more than 1 %.

        **Raises:** `ValueError` for shapes other than (n, 3), no points, an entry that is not finite, a normal of
        length zero, or more points than the capacity.
        """
        points, normals = (as_numbers(rows, name) for rows, name in ((points, "points"), (normals, "normals")))
        require(
            points.ndim == 2 and points.shape[1] == 3 and points.shape == normals.shape,
            f"points and normals must both be (n, 3), got {points.shape} and {normals.shape}",
        )
        count = len(points)
        check_type(capacity, int | None, "the capacity")
        capacity = count if capacity is None else capacity
        require(count > 0, "the cloud is empty: give at least one point and its normal")
        require(capacity <= _MAX_ROWS, f"the capacity is {capacity}; give at most {_MAX_ROWS}")
        require(
            count <= capacity,
            f"{count} points do not fit a capacity of {capacity}: raise the capacity, or thin them first with "
            f"farthest_point_subsample(cloud, {capacity})",
        )
        for name, array in (("points", points), ("normals", normals)):
            bad = np.flatnonzero(~np.isfinite(array).all(axis=1))
            require(
                bad.size == 0,
                f"{bad.size} of the {name} are not finite, the first at row {bad[:1]}: drop these rows",
            )
        lengths = np.linalg.norm(normals.astype(np.float64), axis=1)
        zero = np.flatnonzero(lengths < 1e-12)
        require(
            zero.size == 0,
            f"{zero.size} normals have length zero, the first at row {zero[:1]}: drop these points or estimate normals",
        )
        if np.abs(lengths - 1.0).max() > 0.01:
            worst = int(np.abs(lengths - 1.0).argmax())
            warnings.warn(
                f"normals are not of unit length (row {worst}: {lengths[worst]:.4g}); they were normalised",
                stacklevel=2,
            )
        pad = ((0, capacity - count), (0, 0))
        return cls(
            jnp.asarray(np.pad(points, pad)),
            jnp.asarray(np.pad((normals / lengths[:, None]).astype(points.dtype), pad)),
            jnp.asarray(np.arange(capacity) < count),
        )

    @classmethod
    @checked
    def from_depth(
        cls,
        depth: Real[AnyArray, "height width"],
        camera: Camera,
        pose: Pose,
        depth_scale: float = 1.0,
        stride: int = 1,
        box: Box | None = None,
    ) -> "PointCloud":
        """Convert a depth image to a cloud in the coordinates of the pose, with one row per pixel, row by row.

        Each pixel is a point, missed or invalid (see `PointCloud.missed`):

        - A pixel of +infinity (its ray met nothing in the whole scene) or beyond the camera's range is missed.
        - A pixel that is zero, negative, NaN or below the camera's range is invalid: it gives no information.
        - A value that stands for "not measured" is invalid. This is the largest value of an integer type, or a value
          that fills far more pixels than any value near it and lies beyond the camera's range or well beyond the box.
          The second kind gives a `UserWarning`.

        First, the camera's distortion is removed. Then a plane is fitted to each pixel and to the pixels around it that
        lie on the same surface, within a window that grows with the noise (`geometry/plane_fit.py`). The plane gives
        the point and its normal, which points towards the camera. A pixel is invalid if its neighbours do not define a
        plane. It is also invalid if at least six of its eight neighbours differ from it by more than noise, because
        sensors mix the depths of two surfaces at edges. If the valid pixels have gaps between them, as in a lidar's
        image, planes are fitted to one pixel per block of the gap's size. Each point lies on the ray of its own pixel.

        - `depth`: depths along the camera's forward axis. Integer depths have at least the noise of their rounding.
        - `depth_scale`: factor from the unit of `depth` to the unit of the pose, of the camera's range and of the box,
          such as 0.001 for an image in millimetres and a pose in metres.
        - `stride`: keep every `stride`-th row and column, as `camera.strided` does. Planes are fitted to all pixels.
        - `box`: keep only points inside. A pixel with a hit outside the box becomes invalid if the hit is in front of
          the box, else missed.

        **Raises:** `ValueError` if the image's shape differs from the camera's, all depths are outside the camera's
        range, the box is behind the camera, or depths and the distance of the box differ by orders of magnitude.
        """
        return cls(*points_of_depth(depth, camera, pose, depth_scale, stride, box))

    @property
    def capacity(self) -> int:
        return self.points.shape[-2]

    @property
    @own_settings()
    def count(self) -> Int[Array, "*batch"]:
        """The number of points, that is, of filled rows."""
        return jnp.sum(self.mask, axis=-1)

    @own_settings()
    def to_numpy(self) -> tuple[Float[np.ndarray, "count 3"], Float[np.ndarray, "count 3"]]:
        """Return the points and normals of the filled rows of a single cloud.

        **Raises:** `ValueError` for a batch of clouds.
        """
        check_single(self)
        mask = np.asarray(self.mask)
        return np.asarray(self.points)[mask], np.asarray(self.normals)[mask]

    @own_settings()
    def only(self, mask: Bool[Array, "*batch n"]) -> "PointCloud":
        """Return the cloud with only the points where `mask` is True. `missed` and `sight` do not change."""
        mask = self.mask & mask
        points, normals = (jnp.where(mask[..., None], rows, 0.0) for rows in (self.points, self.normals))
        return PointCloud(points, normals, mask, self.missed, self.sight)

    @own_settings()
    def __getitem__(self, index) -> "PointCloud":
        """Return the cloud, or the batch of clouds, at an index of the leading axes.

        **Raises:** `ValueError` for a single cloud, or if the index is out of range.
        """
        check_index(index, self.mask.shape[:-1], "the cloud")
        return jax.tree.map(lambda leaf: leaf[index], self)

    def __iter__(self) -> Iterator["PointCloud"]:
        """Iterate over the clouds along the first axis of a batch."""
        check_batch(self.mask.shape[:-1], "the cloud")
        return (self[index] for index in range(self.mask.shape[0]))


def some_rows(cloud: PointCloud, count: int) -> Int[Array, " count"]:
    """Return the indices of `count` evenly spaced filled rows. Indices repeat if fewer rows are filled."""
    order = jnp.argsort(~cloud.mask, stable=True)
    return order[(jnp.arange(count) * cloud.count) // count]


def check_single(cloud: PointCloud, name: str = "the cloud") -> None:
    """Raise `ValueError` for a batch of clouds."""
    batch = cloud.mask.shape[:-1]
    require(not batch, f"{name} is a batch {batch} of clouds: give one, or use jax.vmap")


def check_oriented(cloud: PointCloud, name: str, limit: float, unit: bool = True) -> None:
    """Check that a cloud (not traced by JAX) has points within the scene and normals of valid lengths.

    - `limit`: largest magnitude of a coordinate, in scene units.
    - `unit`: whether normals must have unit length (to 1 %). If not, lengths up to 10 are allowed, because a model may
      be conditioned on prior samples, whose normals do not have unit length.

    **Raises:** `ValueError` for an empty cloud, an entry that is not finite, or an invalid normal or point.
    """
    points, normals = cloud.to_numpy()
    require(
        len(points) > 0,
        f"{name} is empty: no point to start from. Point the camera at the object, or check the depth image",
    )
    finite = bool(np.isfinite(points).all() and np.isfinite(normals).all())
    require(finite, f"{name} has points or normals that are not finite: drop or mask these rows")
    lengths = np.linalg.norm(normals, axis=1)
    invalid_lengths = lengths[np.abs(lengths - 1.0) > 0.01] if unit else lengths[lengths > _MAX_NORMAL_LENGTH]
    problem = "not of unit length" if unit else f"longer than {_MAX_NORMAL_LENGTH:g}"
    require(
        invalid_lengths.size == 0,
        f"{name} has {invalid_lengths.size} normals that are {problem}, such as {invalid_lengths[:1]}: build it with "
        "PointCloud.from_arrays, which normalises",
    )
    largest = float(np.abs(points).max())
    require(
        largest <= float(points.dtype.type(limit)),
        f"{name} has a point with a coordinate of {largest:.4g}, outside the scene's cube of half side {limit:.4g}: "
        "bring it to scene coordinates with Frame.to_scene (or simulate less noise)",
    )


@checked
def concatenate(first: PointCloud, second: PointCloud) -> PointCloud:
    """Return one cloud with the points of two clouds (the paper's union of D and D').

    All rows of `first`, even empty ones, come before those of `second`. `missed` and `sight` are None.

    **Raises:** `ValueError` for a batch of clouds.
    """
    for cloud in (first, second):
        check_single(cloud)
    rows = ((cloud.points, cloud.normals, cloud.mask) for cloud in (first, second))
    return PointCloud(*map(jnp.concatenate, zip(*rows, strict=True)))


@checked
@functools.partial(jax.jit, static_argnames="count")
def farthest_point_subsample(cloud: PointCloud, count: int) -> PointCloud:
    """Return a cloud of `count` points, chosen by farthest point sampling (Eldar et al. 1997).

    Sampling starts at the first filled row, and the points are in the order in which they are chosen. If the cloud has
    fewer points than `count`, the remaining rows are empty.

    **Raises:** `ValueError` if `count` < 1.
    """
    check_single(cloud)
    require(1 <= count <= _MAX_ROWS, f"asked for {count} points; ask for at least one and at most {_MAX_ROWS}")
    return _take(cloud, farthest_point_indices(cloud.points, cloud.mask, count))


@own_settings()
@functools.partial(jax.jit, static_argnames="capacity")
def limit_capacity(cloud: PointCloud, capacity: int) -> PointCloud:
    """Return the cloud with `capacity` rows, filled rows first. Farthest point sampling drops the excess.

    **Raises:** `ValueError` if `capacity` < 1.
    """
    require(capacity >= 1, f"a cloud cannot have a capacity of {capacity}; ask for at least one")

    def compact(cloud):
        order = jnp.argsort(~cloud.mask, stable=True)[:capacity]
        return _take(cloud, jnp.pad(order, (0, max(0, capacity - cloud.capacity))))

    if cloud.capacity <= capacity:
        return compact(cloud)
    return jax.lax.cond(
        cloud.count <= capacity, compact, lambda cloud: farthest_point_subsample(cloud, capacity), cloud
    )


def _take(cloud: PointCloud, rows: Int[Array, " m"]) -> PointCloud:
    """Return a cloud of the rows with these indices, of which the first `cloud.count` count as filled."""
    is_filled = jnp.arange(len(rows)) < cloud.count
    points, normals = (jnp.where(is_filled[:, None], array[rows], 0.0) for array in (cloud.points, cloud.normals))
    return PointCloud(points, normals, is_filled)
