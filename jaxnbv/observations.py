"""What has been observed: the points that are kept, the poses that were taken, and which space is empty."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxnbv.checks import check_type
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud, check_single, concatenate, limit_capacity
from jaxnbv.geometry.neighbours import distance_to_others, spacing
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.pose_list import PoseList
from jaxnbv.scanning import Carving, Grid, Looks, Obstacles, barrier_of

# A model takes a hundred or two of the empty points, and the time to choose them grows with how many there are.
_POINTS_ALONG_AXIS = 20
# Of one scan, so that the time does not grow with the square of the capacity; more go with the next.
_MOST_STRAY = 512


class EmptyPoints(NamedTuple):
    """Points (scene coordinates) that were seen to be empty. Rows whose mask is False hold nothing."""

    points: Float[Array, "m 3"]
    mask: Bool[Array, " m"]


class Observations(eqx.Module):
    """What has been observed, in scene coordinates. Immutable and of fixed shapes, so that nothing recompiles.

    - `cloud`: D, the points that are kept.
    - `poses`: the poses that views were taken from.
    - `grid`: of what follows; None where none of it is kept.
    - `looks`: what has been measured, and how far each view saw.
    - `empty_nodes`: the nodes that a scan has shown to be empty.
    - `obstacle_nodes`: the nodes within known obstacles, where the object cannot be.
    - `hypotheses`: what a model carries from view to view, see `SurfaceModel.observed`; None for nothing.
    """

    cloud: PointCloud
    poses: PoseList
    grid: Grid | None = None
    looks: Looks | None = None
    empty_nodes: Bool[Array, "g g g"] | None = None
    obstacle_nodes: Bool[Array, "g g g"] | None = None
    hypotheses: eqx.Module | None = None

    @classmethod
    def start(
        cls,
        cloud: PointCloud,
        max_views: int = 0,
        grid: Grid | None = None,
        obstacle_nodes: Bool[Array, "g g g"] | None = None,
        camera: Camera = Camera(),
    ) -> "Observations":
        """A cloud before any pose is added, with room for `max_views` poses. No node of the grid is empty yet.

        - `camera`: by whose rays looks are kept.
        """
        empty = None if grid is None else jnp.zeros((grid.resolution,) * 3, bool)
        looks = None if grid is None else Looks.none(grid, camera, max_views).with_points(cloud)
        return cls(cloud, PoseList.empty(max_views), grid, looks, empty, obstacle_nodes)

    @property
    def num_views(self) -> Int[Array, ""]:
        """How many poses were taken."""
        return self.poses.count

    @property
    def empty_points(self) -> EmptyPoints:
        """The empty nodes, of every few along each axis, for a model to condition on."""
        if self.empty_nodes is None or self.grid is None:
            return EmptyPoints(jnp.zeros((1, 3), self.cloud.points.dtype), jnp.zeros(1, bool))
        stride = -(-self.grid.resolution // _POINTS_ALONG_AXIS)
        axis = jnp.asarray(self.grid.axis, jnp.result_type(float))[::stride]
        nodes = jnp.stack(jnp.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
        return EmptyPoints(nodes, self.empty_nodes[::stride, ::stride, ::stride].reshape(-1))

    def add_points(self, scan: PointCloud) -> "Observations":
        """The observations with a scan's points in D, which is thinned to its capacity by farthest point sampling and
        loses stray points: those that lie alone where a view has looked through."""
        return dataclasses.replace(self, cloud=_joined(self.cloud, scan, self.empty_nodes, self.grid))

    def add_view(
        self, pose: Pose, scan: PointCloud, camera: Camera, carving: Carving | None, obstacles: Obstacles | None
    ) -> "Observations":
        """The observations with a pose, what the scan from there has measured, and the nodes that it shows to be empty.

        - `carving`: how far from its rays a scan shows a node to be empty; None keeps `empty_nodes` as they are.
        - `obstacles`: what stands before the object; beyond it a ray shows nothing.
        """
        # Without D, whose capacity need not compile this again.
        seen = self.poses, self.looks, self.empty_nodes
        poses, looks, empty = _with_view(*seen, pose, scan, camera, carving, obstacles)
        return dataclasses.replace(self, poses=poses, looks=looks, empty_nodes=empty)


def as_observations(value: Observations | PointCloud) -> Observations:
    """Observations as they are; a cloud alone as observations from no pose.

    **Raises:** `ValueError` for anything else, and for a batch of clouds.
    """
    check_type(value, Observations | PointCloud, "the observations")
    if isinstance(value, Observations):
        return value
    check_single(value)
    return Observations.start(value)


@eqx.filter_jit
def _joined(cloud: PointCloud, scan: PointCloud, empty: Bool[Array, "g g g"] | None, grid: Grid | None) -> PointCloud:
    joined = limit_capacity(concatenate(cloud, scan), cloud.capacity)
    return joined if empty is None or grid is None else joined.only(~_is_stray(joined, empty, grid))


def _is_stray(cloud: PointCloud, empty: Bool[Array, "g g g"], grid: Grid) -> Bool[Array, " n"]:
    """Which points lie in a cell that some view has seen to be empty, and alone.

    A thin part that a view has missed does not lie alone, nor does a surface whose images' poses are a little off:
    thinned, what is connected has a neighbour within twice the spacing.
    """
    crossed = jax.lax.reduce_window(empty, True, jax.lax.bitwise_and, (2, 2, 2), (1, 1, 1), "VALID")
    cell = tuple(grid.cell_of(cloud.points).T)
    inside = cloud.mask & crossed.at[cell].get(mode="fill", fill_value=False)
    (rows,) = jnp.nonzero(inside, size=min(_MOST_STRAY, cloud.capacity), fill_value=cloud.capacity)
    is_alone = distance_to_others(cloud, rows) > 2.0 * spacing(cloud)
    return jnp.zeros(cloud.capacity, bool).at[rows].set(is_alone, mode="drop")


@eqx.filter_jit
def _with_view(
    poses: PoseList,
    looks: Looks | None,
    empty: Bool[Array, "g g g"] | None,
    pose: Pose,
    scan: PointCloud,
    camera: Camera,
    carving: Carving | None,
    obstacles: Obstacles | None,
) -> tuple[PoseList, Looks | None, Bool[Array, "g g g"] | None]:
    if looks is not None and empty is not None:
        barrier = barrier_of(obstacles, camera, pose)
        if carving is not None:
            empty = empty | carving.empty_nodes(looks.grid, pose, scan, camera, barrier)
        looks = looks.with_view(poses.count, pose, scan, camera, barrier)
    return poses.append(pose), looks, empty
