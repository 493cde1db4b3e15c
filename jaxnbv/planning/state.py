"""What a planner knows, what a scan adds to it, and what a scan must be."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from jaxnbv.checks import check_type, is_traced, require
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud, check_single, concatenate, limit_capacity
from jaxnbv.geometry.pose import Pose
from jaxnbv.scanning import Carving, Grid, check_image
from jaxnbv.scanning.surroundings import Surroundings


class State(eqx.Module):
    """What the planner knows: D, and where it has been. Immutable, of fixed shapes.

    - `cloud`: the points that are kept, in scene coordinates.
    - `poses`: the views taken in the first `num_views` rows; the others hold the identity.
    - `seen_empty`: the nodes of the planner's grid that a scan has shown to be empty; None without carving.
    - `half_extent`: of that grid.
    """

    cloud: PointCloud
    poses: Pose
    num_views: Int[Array, ""]
    seen_empty: Bool[Array, "g g g"] | None = None
    half_extent: float | None = eqx.field(static=True, default=None)

    @classmethod
    def before_views(cls, cloud: PointCloud, max_views: int, grid: Grid | None) -> "State":
        """D before any view of it is known, with room for so many.

        - `grid`: on which empty space is kept; None without carving.
        """
        dtype = jnp.result_type(float)
        poses = Pose(np.tile(np.eye(3, dtype=dtype), (max_views, 1, 1)), np.zeros((max_views, 3), dtype))
        none = jnp.asarray(0, jnp.int32)
        if grid is None:
            return cls(cloud, poses, none)
        return cls(cloud, poses, none, jnp.zeros((grid.resolution,) * 3, bool), grid.half_extent)


@eqx.filter_jit
def observe(
    carving: Carving | None,
    grid: Grid,
    surroundings: Surroundings | None,
    state: State,
    pose: Pose,
    scan: PointCloud,
    camera: Camera,
) -> State:
    """The state after a scan from a pose."""
    cloud = limit_capacity(concatenate(state.cloud, scan), state.cloud.capacity)
    state = eqx.tree_at(lambda s: s.cloud, state, cloud)
    return record(carving, grid, surroundings, state, pose, scan, camera)


@eqx.filter_jit
def record(
    carving: Carving | None,
    grid: Grid,
    surroundings: Surroundings | None,
    state: State,
    pose: Pose,
    scan: PointCloud,
    camera: Camera,
) -> State:
    """The state after a view whose points it holds: where that was taken, and what it shows to be empty."""
    poses = jax.tree.map(lambda rows, row: rows.at[state.num_views].set(row), state.poses, pose)
    empty = state.seen_empty
    if carving is not None and empty is not None:
        barrier = None if surroundings is None else surroundings.barrier(camera, pose)
        empty = empty | carving.seen_empty(grid, scan, camera, pose, barrier)
    return State(state.cloud, poses, state.num_views + 1, empty, state.half_extent)


def with_visited(state: State, poses: Sequence[Pose]) -> State:
    """The state in which these poses are taken for visited too. It has room for twice as many, so that its shapes do
    not depend on how many they are."""
    room, count = jax.tree.map(lambda rows: jnp.concatenate([rows, rows]), state.poses), state.num_views
    for pose in poses:
        room, count = jax.tree.map(lambda rows, row, at=count: rows.at[at].set(row), room, pose), count + 1
    return dataclasses.replace(state, poses=room, num_views=count)


def seen_empty(state: State, grid: Grid, carving: Carving | None) -> Bool[Array, "g g g"] | None:
    """What a state knows to be empty, for a planner of this grid; None without carving.

    **Raises:** `ValueError` if the state was made by a planner of another grid or without carving.
    """
    check_type(state, State, "the state")
    if carving is None:
        return None
    found = None if state.seen_empty is None else state.seen_empty.shape
    expected = (grid.resolution,) * 3
    require(
        found == expected,
        f"the state knows empty space on {found} nodes, but the planner carves {expected}: make the state with "
        "this planner's init",
    )
    require(
        state.half_extent == grid.half_extent,
        f"the state knows empty space on a grid that reaches to {state.half_extent}, but the planner's reaches to "
        f"{grid.half_extent}: make the state with this planner's init",
    )
    return state.seen_empty


def check_scan(
    scan: PointCloud, pose: Pose | None, camera: Camera, grid: Grid, carving: Carving | None, first: bool
) -> None:
    """**Raises:** `ValueError` for a scan that `Planner.init` refuses, or `Planner.observe` if it is not the first."""
    for value, hint, name in ((scan, PointCloud, "scan"), (pose, Pose | None, "pose"), (camera, Camera, "camera")):
        check_type(value, hint, f"the {name}")
    check_single(scan, "the scan")
    require(pose is None or pose.position.ndim == 1, "the pose is a batch of poses: give one, poses[0] say")
    if is_traced(scan, pose):
        return
    # Within jit too, values of what is not traced are known.
    with jax.ensure_compile_time_eval():
        _check_values(scan, pose, camera, grid, carving, first)


def _check_values(
    scan: PointCloud, pose: Pose | None, camera: Camera, grid: Grid, carving: Carving | None, first: bool
) -> None:
    points, normals = scan.to_numpy()
    require(
        len(points) > 0 or not first,
        "the first scan is empty: no point to start from. Point the camera at the object, or check the depth image",
    )
    finite = np.isfinite(points).all() and np.isfinite(normals).all()
    require(bool(finite), "the scan has points or normals that are not finite: drop or mask these rows")
    lengths = np.linalg.norm(normals, axis=1)
    wrong = lengths[np.abs(lengths - 1.0) > 0.01]
    require(
        wrong.size == 0,
        f"the scan has {wrong.size} normals that are not of unit length, such as {wrong[:1]}: "
        "build it with PointCloud.from_arrays, which normalises",
    )
    furthest = float(np.abs(points).max(initial=0.0))
    limit = min(grid.half_extent, 0.5 * np.pi)
    require(
        furthest <= limit,
        f"a scanned point has a coordinate of {furthest:.4g}, outside the scene's cube of half side {limit:.4g}: "
        "bring the scan to scene coordinates with Frame.to_scene (or simulate less noise)",
    )
    if pose is not None:
        check_image(scan, camera, pose)
    if carving is not None:
        carving.check_inside(scan, grid)
