"""The planner, which proposes the next view and adds its scan to the observations."""

import dataclasses
import math
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxnbv.acquisition import Acquisition, as_acquisition
from jaxnbv.checks import (
    InputError,
    check_fields,
    check_key,
    check_type,
    functions_of_users,
    is_traced,
    own_settings,
    require,
)
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud, check_oriented, check_single, concatenate, limit_capacity
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.pose_list import PoseList
from jaxnbv.observations import Observations
from jaxnbv.planning.travel import ValuePerCost, total_cost
from jaxnbv.programs import program
from jaxnbv.sampler import StepInputs, SurfaceSampler
from jaxnbv.scanning import Grid, GridSurface, Obstacles, barrier_of, mean_depth, scan_samples
from jaxnbv.scanning.scanner import distance_problem
from jaxnbv.search import DiscreteSearch, Problem, Proposal, Search
from jaxnbv.search.traceable import check_traceable
from jaxnbv.surfaces import FreeRotation, ShapeBank, ShapePoses
from jaxnbv.surfaces.base import HALF_WIDTH
from jaxnbv.surfaces.part_hypotheses import hypotheses_of
from jaxnbv.tasks import Identify
from jaxnbv.utility import Quantity

_PARTS_RESOLUTION = 64

# The constructor converts a plain function to an acquisition, which mypy cannot see.
if TYPE_CHECKING:
    AnyAcquisition: TypeAlias = Any
else:
    AnyAcquisition = Acquisition


class Planner(eqx.Module):
    """Bayesian next-best-view selection (the paper's Algorithm 1): `init`, `propose` and `observe`.

    - `acquisition`: the expected value of a view. A plain function of a cloud counts as a utility, whose expected
      improvement is the acquisition.
    - `search`: method that finds the pose of the highest expected value.
    - `camera`: the sensor whose scans are simulated.
    - `sampler`: draws the surfaces that fit the observations.
    - `cost`: cost of moving the camera from the last view to the next; None to ignore it.
    - `obstacles`: solids around the object, or None. They may hide the object, and cameras keep clear of them.
    - `capacity`: largest number of points in the cloud D. Larger clouds are thinned by farthest point sampling.
    - `max_views`: largest number of views that the observations can hold.

    No method changes the planner or the observations, and all methods run under `jit`. Programs are compiled only at
    the first two views. For a cloud without a pose, use `planner.init(None, cloud)`.

    **Raises:** `ValueError` in the following cases:

    - `capacity` or `max_views` is below one.
    - The search cannot work with the acquisition (a gradient search needs derivatives), the camera or the cost.
    - The acquisition needs known parts, but the sampler's model has none.
    - JAX cannot trace a utility, classifier or segmenter, or one of these returns an array of the wrong shape.
    """

    acquisition: AnyAcquisition = eqx.field(converter=as_acquisition)
    search: Search = DiscreteSearch()
    camera: Camera = Camera()
    sampler: SurfaceSampler = eqx.field(default_factory=SurfaceSampler)
    cost: ValuePerCost | None = None
    obstacles: Obstacles | None = None
    capacity: int = eqx.field(static=True, default=8192)
    max_views: int = eqx.field(static=True, default=32)

    @own_settings()
    def __check_init__(self):
        check_fields(self)
        for name in ("capacity", "max_views"):
            value = getattr(self, name)
            require(value >= 1, f"{name} is {value}; it must be at least 1")
        self.search.check(self.acquisition, self.camera, self.capacity)
        require(
            self.sampler.model.carries_hypotheses or not self.acquisition.needs_hypotheses,
            f"{type(self.acquisition).__name__} needs known parts, but the sampler has none: give it a bank at "
            "true size, sampler.with_bank(ShapeBank.from_meshes(folder, scale='m'), FreeRotation())",
        )
        # Find functions that JAX cannot trace before anything is computed.
        if self.search.uses_samples and self.acquisition.cloud_only:
            check_traceable(self.acquisition, self.capacity, self.camera)
        require(
            self.cost is None or self.search.uses_cost,
            f"{type(self.search).__name__} does not look at the value of a view, so its cost cannot count: leave cost "
            "out, or use another search",
        )

    @classmethod
    def for_parts(cls, bank: ShapeBank, poses: ShapePoses = FreeRotation(), acquisition: Any = Identify()) -> "Planner":  # noqa: B008
        """Return a planner that identifies which part of a bank the object is, and estimates the part's pose.

        - `bank`: parts at true size, in world units (in a simulation, in scene units), for example from
          `ShapeBank.from_meshes(folder, scale="m")` if the world is in metres.
        - `poses`: prior of the part's pose. The default allows every rotation.

        **Raises:** `ValueError` for a bank without parts, or not at true size.
        """
        sampler = SurfaceSampler(grid=Grid(_PARTS_RESOLUTION), num_samples=8).with_bank(bank, poses)
        return cls(acquisition, DiscreteSearch(), Camera(height=24, width=32), sampler, capacity=2000)

    @property
    def quantity(self) -> Quantity:
        """Name and unit of the proposals' values, and the power of length in this unit."""
        quantity = self.search.quantity(self.acquisition)
        return quantity if self.cost is None else self.cost.quantity(quantity)

    @own_settings()
    def init(self, pose: Pose | None, scan: PointCloud, camera: Camera | None = None) -> Observations:
        """Return the observations after a first scan, in scene coordinates.

        The acquisition is evaluated once. A classifier or utility that returns invalid values therefore fails here.

        - `pose`: pose from which the scan was taken; None for a cloud without a pose.
        - `camera`: the camera that took the scan, by default the planner's.

        **Raises:** `ValueError` if the cloud is empty, if a point is not finite or outside the scene's grid, if more
        than a few stray points are outside the carving's volume, if a normal's length differs from 1 by more than 1 %,
        if a sensor's scan does not have one row for each ray of the camera, or if the acquisition's `check` raises it.
        """
        camera = camera or self.camera
        self._check(pose, scan, camera, is_first=True)
        grid = self.sampler.grid
        solid_nodes = None if self.obstacles is None else self.obstacles.within(grid)
        observation_grid = None if solid_nodes is None and self.sampler.carving is None else grid
        observations = Observations.start(
            limit_capacity(scan, self.capacity), self.max_views, observation_grid, solid_nodes, camera
        )
        if self.search.uses_samples and not is_traced(observations):
            if not self.acquisition.cloud_only:
                check_traceable(self.acquisition, observations, self.camera)
            self.acquisition.check(observations.cloud)
            self.sampler.model.check(observations.cloud)
        if pose is not None:
            observations = self._with_view(observations, pose, scan, camera)
        return self.sampler.model.add_state(observations)

    @own_settings()
    def observe(
        self, observations: Observations, pose: Pose, scan: PointCloud, camera: Camera | None = None
    ) -> Observations:
        """Return the observations with one more scan, in scene coordinates.

        A scan without hits adds no points, but its pose and rays still count as a view.

        - `pose`: pose from which the scan was taken.
        - `camera`: the camera that took the scan, by default the planner's. Scans of the same capacity from the same
          camera share one compiled program.

        **Raises:** `ValueError` if the scan is invalid (see `init`), if the observations' grid differs from the
        sampler's, or if the observations already hold `max_views` views.
        """
        camera = camera or self.camera
        check_type(observations, Observations, "observations")
        check_type(pose, Pose, "the pose")
        self._check(pose, scan, camera, is_first=False)
        if not is_traced(observations.num_views):
            views, capacity = int(observations.num_views), observations.poses.capacity
            require(
                views < capacity,
                f"the observations hold {views} views and have room for no more: make them with a planner of "
                f"Planner(max_views=...) greater than {capacity}",
            )
        new_observations = self._with_view(self.sampler.adapt(observations), pose, scan, camera).add_points(scan)
        # An acquisition about known parts uses no samples on the grid.
        if self.search.uses_samples and not self.acquisition.needs_hypotheses and not is_traced(new_observations):
            self.sampler.grid.check(new_observations.cloud)
        return self.sampler.model.add_state(new_observations)

    def replay(self, views: Iterable[tuple[Pose, PointCloud]], camera: Camera | None = None) -> Iterator[Observations]:
        """Yield the observations after each view, by `init` for the first view and `observe` for the others.

        **Raises:** `ValueError` whenever `init` or `observe` raises it.
        """
        observations = None
        for pose, scan in views:
            arguments = (pose, scan, camera)
            observations = self.init(*arguments) if observations is None else self.observe(observations, *arguments)
            yield observations

    @own_settings()
    def propose(self, observations: Observations, key: PRNGKeyArray, pending: PoseList | None = None) -> Proposal:
        """Propose the next pose.

        - `pending`: poses that were proposed earlier but not visited. They are not proposed again.

        **Raises:** `ValueError` if every candidate has been visited, or if the observations' grid is not the sampler's.
        """
        check_key(key)
        sample_key, search_key = jax.random.split(key)
        return self.choose(self.step_inputs(observations, sample_key), search_key, pending)

    @own_settings()
    def step_inputs(self, observations: Observations, key: PRNGKeyArray) -> StepInputs:
        """Return the inputs for `choose`: `sample_inputs`, or only observations if no samples are used."""
        check_type(observations, Observations, "observations")
        return self.sample_inputs(observations, key) if self.search.uses_samples else StepInputs(observations)

    @own_settings()
    def sample_inputs(self, observations: Observations, key: PRNGKeyArray) -> StepInputs:
        """Return the observations, the model's posterior given them, and surfaces drawn from the posterior.

        For an acquisition with `measurable_only` (`NewSurface`), the surfaces leave out regions that an earlier view
        should have measured but did not. For an acquisition with `needs_hypotheses` (`Identify`), there is no
        posterior, and the only surface is that of the most probable part.
        """
        if self.acquisition.needs_hypotheses:
            return StepInputs(observations, None, hypotheses_of(observations).surfaces(self.sampler.grid, 1))
        inputs = self.sampler.step_inputs(observations, key)
        looks, surfaces = inputs.observations.looks, inputs.surfaces
        if looks is None or surfaces is None or not self.acquisition.measurable_only:
            return inputs
        return dataclasses.replace(inputs, surfaces=looks.without_unmeasured(surfaces, inputs.observations.poses))

    @own_settings()
    def choose(self, inputs: StepInputs, key: PRNGKeyArray, pending: PoseList | None = None) -> Proposal:
        """Search for the next pose, given the inputs of the search.

        - `inputs`: result of `step_inputs`, or inputs with samples of your own.
        - `pending`: as for `propose`.

        **Raises:** `ValueError` if every candidate has been visited, or if the value of a candidate is not finite.
        """
        check_key(key)
        check_type(inputs, StepInputs, "the inputs of a step")
        # NaN is valid here, because the standard error of one sample is NaN. NaN from an acquisition is reported below.
        with functions_of_users(), jax.debug_nans(False):
            problem = Problem(inputs, self.camera, self.acquisition, self.obstacles, self.cost, pending).prepared()
            proposal = _propose(self.search, problem, key)
        return _checked_proposal(self, problem, proposal)

    @own_settings()
    @jax.debug_nans(False)
    @program
    def values_at(self, inputs: StepInputs, poses: Pose) -> Float[Array, " poses"]:
        """Return the acquisition's expected value at scene poses (n,), after the cost of the move is applied.

        **Raises:** `ValueError` for inputs without samples.
        """
        return Problem(inputs, self.camera, self.acquisition, self.obstacles, self.cost).prepared().values(poses)

    @own_settings()
    @jax.debug_nans(False)
    @program
    def expected_depth(self, surfaces: GridSurface, pose: Pose) -> Float[Array, "h w"]:
        """Return the expected depth image from a pose, in scene units, see `mean_depth`."""
        scans = scan_samples(surfaces, self.camera, pose[None], barrier_of(self.obstacles, self.camera, pose[None]))
        depth = mean_depth(jax.tree.map(lambda rows: rows[:, 0], scans), pose)
        return depth.reshape(self.camera.height, self.camera.width)

    def _with_view(self, observations: Observations, pose: Pose, scan: PointCloud, camera: Camera) -> Observations:
        # Clutter is left out, because the scan itself shows where clutter blocked a ray.
        obstacles = None if self.obstacles is None else self.obstacles.with_clutter(None)
        return observations.add_view(pose, scan, camera, self.sampler.carving, obstacles)

    def _check(self, pose: Pose | None, scan: PointCloud, camera: Camera, is_first: bool) -> None:
        """Raise `ValueError` for invalid arguments of `init` (if `is_first`) or `observe`."""
        for value, hint, name in ((scan, PointCloud, "scan"), (pose, Pose | None, "pose"), (camera, Camera, "camera")):
            check_type(value, hint, f"the {name}")
        check_single(scan, "the scan")
        require(pose is None or pose.position.ndim == 1, "the pose is a batch of poses: give one, poses[0] say")
        if is_traced(scan, pose):
            return
        # Under jit, operations on concrete arrays would also be traced. This context evaluates them.
        with jax.ensure_compile_time_eval():
            problem = None if pose is None else distance_problem(pose)
            require(problem is None, f"the pose is not of the scene: {problem}")
            if is_first or bool(scan.mask.any()):
                name = "the first scan" if is_first else "the scan"
                check_oriented(scan, name, min(self.sampler.grid.half_extent, HALF_WIDTH))
            require(
                pose is None or scan.missed is None or scan.capacity == camera.num_rays,
                f"the scan has {scan.capacity} rays but the camera {camera.height} x {camera.width}: give the camera "
                "that took it, as observe(observations, pose, scan, camera), and the pose that it was taken from",
            )
            if self.sampler.carving is not None:
                self.sampler.carving.check_inside(scan, self.sampler.grid)


@program
def _propose(search: Search, problem: Problem, key: PRNGKeyArray) -> Proposal:
    return search.propose(problem, key)


def _checked_proposal(planner: Planner, problem: Problem, proposal: Proposal) -> Proposal:
    """Return the proposal if its value is finite. Otherwise raise `ValueError` with the cause."""
    if is_traced(proposal):
        return proposal
    value, search = float(proposal.value), planner.search
    is_number = not math.isnan(value)
    if not is_number or (search.uses_samples and value == math.inf):
        _check_parts(planner, problem, proposal)
        kind = f"acquisition {type(problem.acquisition).__name__}" if search.uses_samples else type(search).__name__
        raise InputError(
            f"the value of {kind} is {'infinite' if is_number else 'not a number (NaN)'} for a candidate: it must be "
            "finite for every scan, also for one that sees nothing; a gradient search needs finite derivatives too"
        )
    require(
        value > -math.inf,
        f"all {proposal.values.shape[0]} candidates have been visited, or no camera may stand there: give the search "
        "more candidates",
    )
    return proposal


def _check_parts(planner: Planner, problem: Problem, proposal: Proposal) -> None:
    """Raise `ValueError` with the name of what is not finite: the cost, or a component of the acquisition."""
    values = proposal.values
    is_invalid = jnp.isnan(values) | (values == jnp.inf)
    pose = proposal.candidates[int(jnp.argmax(is_invalid))] if bool(is_invalid.any()) else proposal.pose
    observations = problem.observations
    if planner.cost is not None and int(observations.num_views) > 0:
        total_cost((observations.poses.last, pose), planner.cost.of)
    if problem.inputs.surfaces is None:
        return
    scans = scan_samples(
        problem.surfaces, problem.camera, pose[None], barrier_of(problem.obstacles, problem.camera, pose[None])
    )
    scores = dataclasses.replace(problem, cost=None).scores(pose[None])
    for sample in np.flatnonzero(~np.isfinite(np.asarray(scores)[..., 0])):
        problem.acquisition.check(concatenate(observations.cloud, scans[int(sample)][0]))
