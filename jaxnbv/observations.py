"""The observations: points of all scans, poses of the views, and space that was seen to be empty."""

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
from jaxnbv.programs import program
from jaxnbv.scanning import Carving, Grid, Looks, Obstacles, barrier_of

# Largest number of nodes per axis of the grid in `empty_points`. A model chooses 100 to 200 of the empty nodes, which
# takes longer with more nodes.
_MAX_POINTS_PER_AXIS = 20
# After each scan, at most this number of points are checked for being stray. The time is proportional to this number
# times the capacity of the cloud. Further points are checked after the next scan.
_MAX_STRAY_CHECKS = 512


class EmptyPoints(NamedTuple):
    """Points (scene coordinates) that were seen to be empty. Rows with a False mask are padding."""

    points: Float[Array, "m 3"]
    mask: Bool[Array, " m"]


class Observations(eqx.Module):
    """Everything observed so far, in scene coordinates. More views do not change the arrays' shapes.

    - `cloud`: the thinned points of all scans, the paper's D.
    - `grid`: the grid of `looks`, `empty_nodes` and `obstacle_nodes`; None if there are none of these.
    - `looks`: the measured surface and the measured ray lengths of each view, see `Looks`.
    - `empty_nodes`: mask of the nodes that some scan showed to be empty.
    - `obstacle_nodes`: mask of the nodes inside known obstacles, where the object cannot be.
    - `hypotheses`: the state that a model carries from view to view, see `SurfaceModel.add_state`; None if the model
      carries no state.
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
        """Return observations of a cloud, with no view yet but room for `max_views`, and with no empty node.

        - `camera`: the sensor's camera. `looks` stores how far each view measured along the rays of this camera.
        """
        empty = None if grid is None else jnp.zeros((grid.resolution,) * 3, bool)
        looks = None if grid is None else Looks.empty(grid, camera, max_views).with_points(cloud)
        return cls(cloud, PoseList.empty(max_views), grid, looks, empty, obstacle_nodes)

    @property
    def num_views(self) -> Int[Array, ""]:
        """Number of views."""
        return self.poses.count

    @property
    def empty_points(self) -> EmptyPoints:
        """Nodes of a coarser grid (at most 20 per axis), with a mask of the nodes that were seen to be empty."""
        if self.empty_nodes is None or self.grid is None:
            return EmptyPoints(jnp.zeros((1, 3), self.cloud.points.dtype), jnp.zeros(1, bool))
        stride = -(-self.grid.resolution // _MAX_POINTS_PER_AXIS)
        axis = jnp.asarray(self.grid.axis, jnp.result_type(float))[::stride]
        nodes = jnp.stack(jnp.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
        return EmptyPoints(nodes, self.empty_nodes[::stride, ::stride, ::stride].reshape(-1))

    def add_points(self, scan: PointCloud) -> "Observations":
        """Return a copy with a scan's points added to the cloud.

        The cloud is thinned to its capacity by farthest point sampling. Then stray points are removed: isolated points
        in space that a view saw to be empty.
        """
        return dataclasses.replace(self, cloud=_join(self.cloud, scan, self.empty_nodes, self.grid))

    def add_view(
        self, pose: Pose, scan: PointCloud, camera: Camera, carving: Carving | None, obstacles: Obstacles | None
    ) -> "Observations":
        """Return a copy with one more view: its pose, measured surface, and nodes that it showed to be empty.

        - `carving`: decides which nodes the scan shows to be empty. None leaves `empty_nodes` unchanged.
        - `obstacles`: solids that may hide the object. A ray shows nothing behind them.
        """
        # The cloud is not an argument, because the program would be compiled again for each capacity of the cloud.
        fields = self.poses, self.looks, self.empty_nodes
        poses, looks, empty = _with_view(*fields, pose, scan, camera, carving, obstacles)
        return dataclasses.replace(self, poses=poses, looks=looks, empty_nodes=empty)


def as_observations(value: Observations | PointCloud) -> Observations:
    """Convert a cloud to observations without views; return observations unchanged.

    **Raises:** `ValueError` for any other type, and for a batch of clouds.
    """
    check_type(value, Observations | PointCloud, "the observations")
    if isinstance(value, Observations):
        return value
    check_single(value)
    return Observations.start(value)


@program
def _join(cloud: PointCloud, scan: PointCloud, empty: Bool[Array, "g g g"] | None, grid: Grid | None) -> PointCloud:
    union = limit_capacity(concatenate(cloud, scan), cloud.capacity)
    return union if empty is None or grid is None else union.only(~_is_stray(union, empty, grid))


def _is_stray(cloud: PointCloud, empty: Bool[Array, "g g g"], grid: Grid) -> Bool[Array, " n"]:
    """Return whether each point is stray: alone, and in a grid cell whose nodes were all seen to be empty.

    A point is alone if no other point is within twice the spacing, the median distance between neighbours. In a thinned
    cloud, points on a connected surface are about one spacing apart, so they are not alone. They are kept even if their
    cell was wrongly seen to be empty, because a view missed a thin part or has a slightly wrong pose.
    """
    is_empty_cell = jax.lax.reduce_window(empty, True, jax.lax.bitwise_and, (2, 2, 2), (1, 1, 1), "VALID")
    cell = tuple(grid.cell_of(cloud.points).T)
    is_in_empty_cell = cloud.mask & is_empty_cell.at[cell].get(mode="fill", fill_value=False)
    (rows,) = jnp.nonzero(is_in_empty_cell, size=min(_MAX_STRAY_CHECKS, cloud.capacity), fill_value=cloud.capacity)
    is_alone = distance_to_others(cloud, rows) > 2.0 * spacing(cloud)
    return jnp.zeros(cloud.capacity, bool).at[rows].set(is_alone, mode="drop")


@program
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
