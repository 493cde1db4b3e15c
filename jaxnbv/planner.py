"""The planner: ask for the next view, tell what it showed. A simulated episode and a real scanner call the same two."""

from collections.abc import Iterable, Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from jaxnbv.acquisition import Score
from jaxnbv.camera import Camera, Pose
from jaxnbv.checks import check_fields, check_type, is_traced, require
from jaxnbv.cloud import PointCloud, concatenate, limit_capacity
from jaxnbv.scanning import Carving, Grid, GridSurface, carve, check_image
from jaxnbv.search import Problem, Proposal, Search
from jaxnbv.surfaces import SurfaceModel, SurfacePosterior


class State(eqx.Module):
    """What the planner knows: D, and where it has been. Immutable, of fixed shapes.

    - `cloud`: the points that are kept, in scene coordinates.
    - `poses`: the views taken in the first `num_views` rows; the others hold the identity.
    - `seen_empty`: the nodes of the planner's grid that a scan has shown to be empty; None without carving.
    """

    cloud: PointCloud
    poses: Pose
    num_views: Int[Array, ""]
    seen_empty: Bool[Array, "g g g"] | None = None


class Planner(eqx.Module):
    """Bayesian next-best-view selection (the paper's Algorithm 1) as ask/tell over an immutable state.

    - `model`: the prior over surfaces.
    - `camera`: the sensor whose scans are imagined.
    - `acquisition`: the score whose expectation is maximised.
    - `search`: how.
    - `num_samples`: S, posterior samples a step.
    - `grid`: where the samples are evaluated and scanned.
    - `capacity`: points of D that are kept, by farthest point sampling beyond it.
    - `max_views`: views that a state has room for.
    - `carving`: what samples are cut by: space seen empty, on which the model is conditioned too where it can be, and
      the outside of a volume. None leaves samples as the model draws them from D, which is the paper's own behaviour.

    All methods are pure and run under `jit`. They compile once a planner: at the first view, nothing after the second.

    **Raises:** `ValueError` for numbers below one, and if the search cannot work with the acquisition or the camera: a
    gradient search with a score that JAX cannot differentiate, say.
    """

    model: SurfaceModel
    camera: Camera
    acquisition: Score
    search: Search
    num_samples: int = eqx.field(static=True, default=16)
    grid: Grid = Grid()
    capacity: int = eqx.field(static=True, default=8192)
    max_views: int = eqx.field(static=True, default=32)
    carving: Carving | None = Carving()

    def __check_init__(self):
        check_fields(self)
        for name in ("num_samples", "capacity", "max_views"):
            value = getattr(self, name)
            require(value >= 1, f"{name} is {value}; it must be at least 1")
        self.search.check(self.acquisition, self.camera, self.capacity)

    def init(self, cloud: PointCloud, pose: Pose | None = None, camera: Camera | None = None) -> State:
        """The state after a first scan, in scene coordinates, taken from `pose` (None where it is not known).

        `camera`: the one that took the scan, by default the planner's.

        The score is asked once about the cloud, so that a classifier or utility which gives something impossible says
        so at once.

        **Raises:** `ValueError` if the cloud is empty, if a point is not finite or outside the scene's grid, or more
        than stray ones outside the carving's volume, a normal not of unit length (to 1 %), or the scan an image of
        another camera or from another pose; and as the acquisition's `check` does.
        """
        camera = camera or self.camera
        self._check_scan(cloud, pose, camera, first=True)
        poses = Pose(np.tile(np.eye(3), (self.max_views, 1, 1)), np.zeros((self.max_views, 3)))
        poses = jax.tree.map(lambda leaf: leaf.astype(jnp.result_type(float)), poses)
        empty = None if self.carving is None else jnp.zeros((self.grid.resolution,) * 3, bool)
        kept = limit_capacity(cloud, self.capacity)
        if self.search.uses_samples and not is_traced(kept):
            self.acquisition.check(kept)
            self.model.check(kept)
        state = State(kept, poses, jnp.asarray(0, jnp.int32), empty)
        return state if pose is None else _record(self.carving, self.grid, state, pose, cloud, camera)

    def posterior(self, state: State) -> SurfacePosterior:
        """p(f | D, what was seen empty), of which `sample_surfaces` draws its samples before it carves them.

        **Raises:** `ValueError` as the model's `condition` does, and if the state was made by a planner of another grid
        or without carving.
        """
        return _posterior(self.model, self.carving, self.grid, state.cloud, self._seen_empty(state))

    def carve(self, state: State, values: Float[Array, "*s g g g"]) -> Float[Array, "*s g g g"]:
        """Values of f minus its level at the grid's nodes, carved by what the state knows to be empty."""
        return _carve(self.carving, self.grid, self._seen_empty(state), values)

    def sample_surfaces(
        self, state: State, key: PRNGKeyArray, posterior: SurfacePosterior | None = None
    ) -> GridSurface:
        """S samples of the surface given D, carved, on the grid, along a leading axis.

        `posterior`: that of the state, where it is at hand already.

        **Raises:** `ValueError` as `posterior` does, and if the model gives values that are not finite.
        """
        empty = self._seen_empty(state)
        surfaces = _sample_surfaces(
            self.model, self.carving, self.grid, self.num_samples, state.cloud, empty, key, posterior
        )
        if not is_traced(surfaces):
            require(
                bool(jnp.isfinite(surfaces.values).all()),
                f"the samples of the surface given {int(state.cloud.count)} points are not finite: raise the model's "
                "noise, or enable jax_enable_x64",
            )
        return surfaces

    def propose(self, state: State, key: PRNGKeyArray) -> Proposal:
        """Ask: the pose to take next, and what the search looked at.

        **Raises:** `ValueError` if every candidate has been visited.
        """
        sample_key, search_key = jax.random.split(key)
        surfaces = self.sample_surfaces(state, sample_key) if self.search.uses_samples else None
        return self.choose(state, surfaces, search_key)

    def choose(self, state: State, surfaces: GridSurface | None, key: PRNGKeyArray) -> Proposal:
        """The second half of `propose`: the search, given the step's samples (any that a model of your own drew).

        **Raises:** `ValueError` if every candidate has been visited, or a score is NaN.
        """
        proposal = _choose(
            self.search, self.acquisition, self.camera, state.cloud, state.poses, state.num_views, surfaces, key
        )
        if not is_traced(proposal):
            require(
                not bool(jnp.isnan(proposal.value)),
                "the acquisition is not a number (NaN) for a candidate: the score must be finite for every scan, "
                "one that sees nothing included, and for a gradient search so must its derivatives",
            )
            require(
                bool(proposal.value > -jnp.inf),
                f"all {proposal.values.shape[0]} candidates have been visited: give the search more candidates",
            )
        return proposal

    def observe(self, state: State, pose: Pose, scan: PointCloud, camera: Camera | None = None) -> State:
        """Tell: the state after a scan (scene coordinates) from a pose. A scan that saw nothing adds no points.

        `camera`: the one that took the scan, by default the planner's. Scans of one capacity and camera share one
        compilation.

        **Raises:** `ValueError` for a scan as `init` does, if the state was made by a planner of another grid or
        without carving, or if it has no room for another view.
        """
        camera = camera or self.camera
        self._check_scan(scan, pose, camera, first=False)
        self._seen_empty(state)
        if not is_traced(state.num_views):
            require(
                int(state.num_views) < self.max_views,
                f"the state holds {int(state.num_views)} views and has room for no more: raise Planner(max_views=...)",
            )
        after = _observe(self.carving, self.grid, state, pose, scan, camera)
        if self.search.uses_samples and not is_traced(after):
            self.grid.check(after.cloud)
        return after

    def replay(self, views: Iterable[tuple[Pose, PointCloud]], camera: Camera | None = None) -> Iterator[State]:
        """The state after each of some views, poses and scans: `init` with the first, then `observe`.

        **Raises:** `ValueError` as these do.
        """
        state = None
        for pose, scan in views:
            state = self.init(scan, pose, camera) if state is None else self.observe(state, pose, scan, camera)
            yield state

    def _seen_empty(self, state: State) -> Bool[Array, "g g g"] | None:
        if self.carving is None:
            return None
        found = None if state.seen_empty is None else state.seen_empty.shape
        expected = (self.grid.resolution,) * 3
        require(
            found == expected,
            f"the state knows empty space on {found} nodes, but the planner carves {expected}: make the state with "
            "this planner's init",
        )
        return state.seen_empty

    def _check_scan(self, scan: PointCloud, pose: Pose | None, camera: Camera, first: bool) -> None:
        for value, hint, name in ((scan, PointCloud, "scan"), (pose, Pose | None, "pose"), (camera, Camera, "camera")):
            check_type(value, hint, f"the {name}")
        if is_traced(scan, pose):
            return
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
        limit = min(self.grid.half_extent, 0.5 * np.pi)
        require(
            furthest <= limit,
            f"a scanned point has a coordinate of {furthest:.4g}, outside the scene's cube of half side {limit:.4g}: "
            "bring the scan to scene coordinates with Frame.to_scene (or simulate less noise)",
        )
        if pose is not None:
            check_image(scan, camera, pose)
        if self.carving is not None:
            self.carving.check_inside(scan, self.grid)


# What is compiled takes what it uses, not the planner: another score or search does not compile the sampler again.


def _posterior(
    model: SurfaceModel, carving: Carving | None, grid: Grid, cloud: PointCloud, empty: Bool[Array, "g g g"] | None
) -> SurfacePosterior:
    if carving is None or empty is None:
        return model.condition(cloud)
    return model.condition_on_space(cloud, carving.empty_points(grid, empty))


def _carve(
    carving: Carving | None, grid: Grid, empty: Bool[Array, "g g g"] | None, values: Float[Array, "*s g g g"]
) -> Float[Array, "*s g g g"]:
    return values if carving is None or empty is None else carve(values, empty | carving.outside(grid))


@eqx.filter_jit
def _sample_surfaces(
    model: SurfaceModel,
    carving: Carving | None,
    grid: Grid,
    num_samples: int,
    cloud: PointCloud,
    empty: Bool[Array, "g g g"] | None,
    key: PRNGKeyArray,
    posterior: SurfacePosterior | None,
) -> GridSurface:
    posterior = _posterior(model, carving, grid, cloud, empty) if posterior is None else posterior
    values = posterior.sample(key, num_samples).on_grid(grid.axis) - posterior.level
    return GridSurface.from_values(_carve(carving, grid, empty, values), 0.0, grid)


@eqx.filter_jit
def _choose(
    search: Search,
    acquisition: Score,
    camera: Camera,
    cloud: PointCloud,
    visited: Pose,
    num_visited: Int[Array, ""],
    surfaces: GridSurface | None,
    key: PRNGKeyArray,
) -> Proposal:
    return search.propose(Problem(cloud, visited, num_visited, camera, acquisition, surfaces), key)


@eqx.filter_jit
def _observe(carving: Carving | None, grid: Grid, state: State, pose: Pose, scan: PointCloud, camera: Camera) -> State:
    cloud = limit_capacity(concatenate(state.cloud, scan), state.cloud.capacity)
    return _record(carving, grid, eqx.tree_at(lambda s: s.cloud, state, cloud), pose, scan, camera)


@eqx.filter_jit
def _record(carving: Carving | None, grid: Grid, state: State, pose: Pose, scan: PointCloud, camera: Camera) -> State:
    poses = jax.tree.map(lambda rows, row: rows.at[state.num_views].set(row), state.poses, pose)
    empty = state.seen_empty
    if carving is not None and empty is not None:
        empty = empty | carving.seen_empty(grid, scan, camera, pose)
    return State(state.cloud, poses, state.num_views + 1, empty)
