"""The planner: ask for the next view, tell what it showed. A simulated episode and a real scanner call the same two."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, PRNGKeyArray

from jaxnbv.acquisition import Score
from jaxnbv.camera import Camera, Pose
from jaxnbv.checks import is_traced, require
from jaxnbv.cloud import PointCloud, concatenate, limit_capacity
from jaxnbv.scanning import Grid, GridSurface
from jaxnbv.search import Problem, Proposal, Search
from jaxnbv.surfaces import SurfaceModel


class State(eqx.Module):
    """What the planner knows: D, and where it has been. Immutable, of fixed shapes.

    - `cloud`: the points that are kept, in scene coordinates.
    - `poses`: the views taken in the first `num_views` rows; the others hold the identity.
    """

    cloud: PointCloud
    poses: Pose
    num_views: Int[Array, ""]


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

    def __check_init__(self):
        for name in ("num_samples", "capacity", "max_views"):
            value = getattr(self, name)
            require(isinstance(value, int) and value >= 1, f"{name} is {value}; it must be a whole number, at least 1")
        self.search.check(self.acquisition, self.camera, self.capacity)

    def init(self, cloud: PointCloud, pose: Pose | None = None) -> State:
        """The state after a first scan, in scene coordinates, taken from `pose` (None where it is not known).

        **Raises:** `ValueError` if the cloud is empty, if a point is not finite or outside the scene's grid, or a
        normal not of unit length (to 1 %).
        """
        self._check_scan(cloud, first=True)
        poses = Pose(np.tile(np.eye(3), (self.max_views, 1, 1)), np.zeros((self.max_views, 3)))
        poses = jax.tree.map(lambda leaf: leaf.astype(jnp.result_type(float)), poses)
        state = State(limit_capacity(cloud, self.capacity), poses, jnp.asarray(0, jnp.int32))
        return state if pose is None else _record(state, pose)

    def sample_surfaces(self, state: State, key: PRNGKeyArray) -> GridSurface:
        """S samples of the surface given D, on the grid, along a leading axis.

        **Raises:** `ValueError` if the model gives values that are not finite.
        """
        surfaces = _sample_surfaces(self, state.cloud, key)
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
        proposal = _choose(self, state, surfaces, key)
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

    def observe(self, state: State, pose: Pose, scan: PointCloud) -> State:
        """Tell: the state after a scan (scene coordinates) from a pose. A scan that saw nothing only records the pose.

        Scans of one capacity share one compilation.

        **Raises:** `ValueError` if a point is not finite or outside the scene's grid, a normal not of unit length (to
        1 %), or if the state has no room for another view.
        """
        self._check_scan(scan, first=False)
        if not is_traced(state.num_views):
            require(
                int(state.num_views) < self.max_views,
                f"the state holds {int(state.num_views)} views and has room for no more: raise Planner(max_views=...)",
            )
        return _observe(state, pose, scan)

    def _check_scan(self, scan: PointCloud, first: bool) -> None:
        if is_traced(scan):
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


@eqx.filter_jit
def _sample_surfaces(planner: Planner, cloud: PointCloud, key: PRNGKeyArray) -> GridSurface:
    posterior = planner.model.condition(cloud)
    fields = posterior.sample(key, planner.num_samples)
    return GridSurface.from_values(fields.on_grid(planner.grid.axis), posterior.level, planner.grid)


@eqx.filter_jit
def _choose(planner: Planner, state: State, surfaces: GridSurface | None, key: PRNGKeyArray) -> Proposal:
    problem = Problem(state.cloud, state.poses, state.num_views, planner.camera, planner.acquisition, surfaces)
    return planner.search.propose(problem, key)


@eqx.filter_jit
def _observe(state: State, pose: Pose, scan: PointCloud) -> State:
    cloud = limit_capacity(concatenate(state.cloud, scan), state.cloud.capacity)
    return _record(State(cloud, state.poses, state.num_views), pose)


@eqx.filter_jit
def _record(state: State, pose: Pose) -> State:
    poses = jax.tree.map(lambda rows, row: rows.at[state.num_views].set(row), state.poses, pose)
    return State(state.cloud, poses, state.num_views + 1)
