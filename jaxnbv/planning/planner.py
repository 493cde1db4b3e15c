"""The planner: ask for the next view, tell what it showed. A simulated episode and a real scanner call the same two."""

from collections.abc import Iterable, Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxnbv.acquisition import Score
from jaxnbv.answers import Quantity
from jaxnbv.checks import check_fields, check_key, check_type, is_traced, require, shown
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud, limit_capacity
from jaxnbv.geometry.pose import Pose
from jaxnbv.planning.state import State, check_scan, observe, record, seen_empty, with_visited
from jaxnbv.planning.travel import Cost, arc_length
from jaxnbv.sampling import carved, posterior_of, sample_surfaces
from jaxnbv.scanning import Carving, Grid, GridSurface, imagine, nothing_imagined
from jaxnbv.scanning.surroundings import Surroundings
from jaxnbv.search import Batch, Problem, Proposal, Search
from jaxnbv.surfaces import SurfaceModel, SurfacePosterior


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
    - `cost`: `ValuePerCost` or `ValueMinusCost` of going from the last view to the next; None where it does not count.
    - `surroundings`: what stands around the object, hides it, and keeps cameras out; None for nothing.
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
    cost: Cost | None = None
    surroundings: Surroundings | None = None

    def __check_init__(self):
        check_fields(self)
        for name in ("num_samples", "capacity", "max_views"):
            value = getattr(self, name)
            require(value >= 1, f"{name} is {value}; it must be at least 1")
        require(
            self.grid.half_extent <= np.pi,
            f"the grid reaches to {self.grid.half_extent}, beyond the torus [-pi, pi]^3: give Grid(half_extent=...)",
        )
        self.search.check(self.acquisition, self.camera, self.capacity)
        require(
            self.cost is None or self.search.weighs_cost,
            f"{type(self.search).__name__} does not look at what a view is worth, so its cost cannot count: leave cost "
            "out, or use another search",
        )

    @property
    def quantity(self) -> Quantity:
        """What the values of its proposals are."""
        value = self.search.quantity(self.acquisition)
        return value if self.cost is None else self.cost.quantity(value)

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
        check_scan(cloud, pose, camera, self.grid, self.carving, first=True)
        kept = limit_capacity(cloud, self.capacity)
        if self.search.uses_samples and not is_traced(kept):
            self.acquisition.check(kept)
            self.model.check(kept)
        state = State.before_views(kept, self.max_views, None if self.carving is None else self.grid)
        return state if pose is None else record(self.carving, self.grid, self.surroundings, state, pose, cloud, camera)

    def posterior(self, state: State) -> SurfacePosterior:
        """p(f | D, what was seen empty), of which `sample_surfaces` draws its samples before it carves them.

        **Raises:** `ValueError` as the model's `condition` does, and if the state was made by a planner of another grid
        or without carving.
        """
        empty = seen_empty(state, self.grid, self.carving)
        return posterior_of(self.model, self.carving, self.grid, state.cloud, empty)

    def carve(self, state: State, values: Float[Array, "*s g g g"]) -> Float[Array, "*s g g g"]:
        """Values of f minus its level at the grid's nodes, carved by what the state knows to be empty.

        **Raises:** `ValueError` if the values or the state are of another grid.
        """
        empty, nodes = seen_empty(state, self.grid, self.carving), (self.grid.resolution,) * 3
        require(
            jnp.shape(values)[-3:] == nodes, f"the values are {shown(values)}, but the planner's grid has {nodes} nodes"
        )
        return carved(self.carving, self.grid, self.surroundings, empty, values)

    def sample_surfaces(
        self, state: State, key: PRNGKeyArray, posterior: SurfacePosterior | None = None
    ) -> GridSurface:
        """S samples of the surface given D, carved, on the grid, along a leading axis.

        `posterior`: that of the state, where it is at hand already.

        **Raises:** `ValueError` as `posterior` does, and if the model gives values that are not finite.
        """
        check_key(key)
        check_type(posterior, SurfacePosterior | None, "the posterior")
        empty = seen_empty(state, self.grid, self.carving)
        surfaces = sample_surfaces(
            self.model, self.carving, self.grid, self.surroundings, self.num_samples, state.cloud, empty, key, posterior
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
        check_key(key)
        sample_key, search_key = jax.random.split(key)
        surfaces = self.sample_surfaces(state, sample_key) if self.search.uses_samples else None
        return self.choose(state, surfaces, search_key)

    def propose_batch(self, state: State, key: PRNGKeyArray, count: int) -> Batch:
        """Several poses to take before the next question, chosen greedily: each is worth what it adds, sample by
        sample, to what the scans before it would show of the same posterior sample. The first is that of `propose`.

        For searches that do not look at samples, each is chosen as if those before it had been visited.

        **Raises:** `ValueError` for fewer than one, or more than the state has room for, or as `propose` does.
        """
        check_key(key)
        check_type(count, int, "the number of views")
        check_type(state, State, "the state")
        room = state.poses.position.shape[0] - (0 if is_traced(state.num_views) else int(state.num_views))
        require(1 <= count <= room, f"asked for {count} views at once; give 1 to {room}, for which there is room")
        sample_key, search_key = jax.random.split(key)
        surfaces = self.sample_surfaces(state, sample_key) if self.search.uses_samples else None
        proposals = [self.choose(state, surfaces, search_key)]
        imagined = None if surfaces is None else nothing_imagined(surfaces, self.camera, count - 1)
        for index in range(count - 1):
            if surfaces is not None and imagined is not None:
                pose = proposals[-1].pose
                barrier = self.barrier(pose[None])
                imagined = imagine(imagined, surfaces, self.camera, pose, barrier, jnp.asarray(index))
            after = with_visited(state, [proposal.pose for proposal in proposals])
            proposals.append(self.choose(after, surfaces, jax.random.fold_in(search_key, index), imagined))
        seen = is_traced(state.num_views) or int(state.num_views) > 0
        start = jax.tree.map(lambda rows: rows[state.num_views - 1], state.poses) if seen else None
        return Batch(tuple(proposals), start, arc_length if self.cost is None else self.cost.of)

    def choose(
        self, state: State, surfaces: GridSurface | None, key: PRNGKeyArray, imagined: PointCloud | None = None
    ) -> Proposal:
        """The second half of `propose`: the search, given the step's samples (any that a model of your own drew).

        - `imagined`: what would be known of each of the samples before this view, beside D; of leading axis S.

        **Raises:** `ValueError` if every candidate has been visited, or a score is not finite.
        """
        check_key(key)
        check_type(state, State, "the state")
        check_type(surfaces, GridSurface | None, "the surfaces")
        check_type(imagined, PointCloud | None, "what is imagined")
        asked = surfaces, self.cost, imagined, self.surroundings
        proposal = _choose(self.search, self.acquisition, self.camera, state, *asked, key)
        if not is_traced(proposal):
            require(
                not bool(jnp.isnan(proposal.value)) and (surfaces is None or bool(proposal.value < jnp.inf)),
                f"the acquisition is {_in_words(proposal.value)} for a candidate: the score must be finite for every "
                "scan, one that sees nothing included, and for a gradient search so must its derivatives",
            )
            require(
                bool(proposal.value > -jnp.inf),
                f"all {proposal.values.shape[0]} candidates have been visited, or no camera may stand there: give the "
                "search more candidates",
            )
        return proposal

    def barrier(self, poses: Pose) -> Float[Array, "poses rays"] | None:
        """How far along the camera's rays from each of a batch of poses obstacles stand; None without any."""
        return None if self.surroundings is None else self.surroundings.barrier(self.camera, poses)

    def observe(self, state: State, pose: Pose, scan: PointCloud, camera: Camera | None = None) -> State:
        """Tell: the state after a scan (scene coordinates) from a pose. A scan that saw nothing adds no points.

        `camera`: the one that took the scan, by default the planner's. Scans of one capacity and camera share one
        compilation.

        **Raises:** `ValueError` for a scan as `init` does, if the state was made by a planner of another grid or
        without carving, or if it has no room for another view.
        """
        camera = camera or self.camera
        check_type(pose, Pose, "the pose")
        check_scan(scan, pose, camera, self.grid, self.carving, first=False)
        seen_empty(state, self.grid, self.carving)
        if not is_traced(state.num_views):
            views, room = int(state.num_views), state.poses.position.shape[0]
            require(
                views < room,
                f"the state holds {views} views and has room for no more: make it with a planner of "
                f"Planner(max_views=...) greater than {room}",
            )
        after = observe(self.carving, self.grid, self.surroundings, state, pose, scan, camera)
        if self.search.uses_samples and not is_traced(after):
            self.grid.check(after.cloud)
        return after

    def replay(
        self, views: Iterable[tuple[Pose, PointCloud] | tuple[Pose, PointCloud, Camera | None]]
    ) -> Iterator[State]:
        """The state after each of some views, poses and scans: `init` with the first, then `observe`. A third says
        which camera took a scan.

        **Raises:** `ValueError` as these do.
        """
        state = None
        for view in views:
            known = isinstance(view, tuple | list) and len(view) in (2, 3)
            require(known, f"a view is {shown(view)}; give pairs of a pose and a scan")
            pose, scan, *camera = view
            state = self.init(scan, pose, *camera) if state is None else self.observe(state, pose, scan, *camera)
            yield state


def _in_words(value: Float[Array, ""]) -> str:
    return "not a number (NaN)" if jnp.isnan(value) else "infinite"


# As of `sampling`: another model does not compile the search again.


@eqx.filter_jit
def _choose(
    search: Search,
    acquisition: Score,
    camera: Camera,
    state: State,
    surfaces: GridSurface | None,
    cost: Cost | None,
    imagined: PointCloud | None,
    surroundings: Surroundings | None,
    key: PRNGKeyArray,
) -> Proposal:
    known, empty = (state.cloud, state.poses, state.num_views), (state.seen_empty, state.half_extent)
    problem = Problem(*known, camera, acquisition, surfaces, cost, imagined, surroundings, *empty)
    return search.propose(problem, key)
