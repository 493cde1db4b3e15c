"""The loop of an episode: propose a pose, take the view, add the scan, and check the stop rule.

Simulations, studies and sessions at a real sensor use the same `Loop`, which holds all state that depends on the views.
"""

import copy
import dataclasses
import time
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple, TypeAlias

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from jaxnbv.acquisition import Acquisition
from jaxnbv.checks import AnyArray, InputError, own_settings
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.pose_list import PoseList
from jaxnbv.observations import Observations
from jaxnbv.planning.planner import Planner
from jaxnbv.planning.stopping import StopContext, StopRule, checked_reason
from jaxnbv.programs import program
from jaxnbv.sampler import StepInputs
from jaxnbv.scanning import GridSurface
from jaxnbv.scanning.sdf import SignedDistance
from jaxnbv.search import Proposal
from jaxnbv.surfaces.part_hypotheses import PartHypotheses
from jaxnbv.tasks.identification import identity_answer
from jaxnbv.utility import Answer

Sensor: TypeAlias = Callable[[Pose, PRNGKeyArray], PointCloud]
"""Function that returns the scan from a pose. The key determines simulated noise."""

STAGES = ("sampling surfaces", "searching", "scanning")


class View(eqx.Module):
    """One view of an episode, in scene coordinates.

    - `scan`: the scan, with noise and one row for each pixel.
    - `cloud`: the cloud D after this view.
    - `proposal`: the proposal of this view; None if the view was not proposed, such as the first view.
    - `camera`: the camera that took the scan, in scene units.
    - `hypotheses`: hypotheses of the model after this view, see `Observations`.
    """

    pose: Pose
    scan: PointCloud
    cloud: PointCloud
    proposal: Proposal | None
    camera: Camera
    hypotheses: eqx.Module | None = None

    def answer(self, acquisition: Acquisition) -> Answer | None:
        """Return the acquisition's answer after this view, or else the probability of each known part.

        Return None if the acquisition has no answer and the model has no known parts.
        """
        answer = acquisition.answer(self.cloud)
        if answer is None and isinstance(self.hypotheses, PartHypotheses):
            return identity_answer(self.hypotheses, acquisition)
        return answer


class Step(NamedTuple):
    """A view of an episode, and the search that proposed the view.

    - `observations`: observations after the view.
    - `inputs`, `seconds`: inputs and duration of the search. They are None and zero for the first view and for a view
      read from a folder. The inputs are also None if the search uses no samples.
    """

    view: View
    observations: Observations
    inputs: StepInputs | None
    seconds: float


@dataclasses.dataclass
class _StepState:
    """Intermediate results for the next view.

    - `is_proposed`: whether a caller received the proposal. False if it was computed for the stop rule only.
    - `stop`: the stop rule's reason to stop; None to continue.
    - `is_evaluated`: whether the stop rule was evaluated, so that `stop` is valid.
    """

    inputs: StepInputs | None = None
    proposal: Proposal | None = None
    is_proposed: bool = False
    seconds: float = 0.0
    stop: str | None = None
    is_evaluated: bool = False


class Loop:
    """A running episode.

    The cost of the next move and the distance to earlier cameras are computed from the actual poses of views. No pose
    is proposed twice, even if the view was taken elsewhere.

    - `planner`: the planner, in scene coordinates.
    - `key`: random key. The random keys of view i depend only on `key` and i.
    - `until`: stop rule, or None.
    - `frame`: frame of the user's world, in whose units the stop rule computes.
    - `camera`: the sensor's camera in scene units, by default the planner's.
    - `on_stage`: function that is called with a name from `STAGES` when this stage begins.

    **Raises:** `ValueError` if the rule does not apply to the planner.
    """

    @own_settings()
    def __init__(
        self,
        planner: Planner,
        key: PRNGKeyArray,
        until: StopRule | None = None,
        frame: Frame = Frame(),  # noqa: B008
        camera: Camera | None = None,
        on_stage: Callable[[str], None] = lambda stage: None,
    ):
        if until is not None:
            until.check(planner)
        self.planner, self.key, self.until, self.frame = planner, key, until, frame
        self.camera, self._on_stage = camera or planner.camera, on_stage
        self.views: tuple[View, ...] = ()
        self._observations: Observations | None = None
        self._pending = PoseList.empty(planner.max_views)
        self._first_view_time: float | None = None
        self._next = _StepState()

    def without_views(self, planner: Planner) -> "Loop":
        """Return a copy without views that uses `planner`, for when obstacles or earlier poses have changed.

        The copy keeps the time of the first view, from which stop rules count seconds.
        """
        loop = copy.copy(self)
        loop.planner, loop.views, loop._observations = planner, (), None
        loop._pending, loop._next = PoseList.empty(planner.max_views), _StepState()
        return loop

    def with_clutter(self, clutter: SignedDistance | None) -> "Loop":
        """Return a copy in which `clutter` (scene units) replaces the clutter among the planner's obstacles."""
        assert self.planner.obstacles is not None
        loop = copy.copy(self)
        # tree_at skips the planner's checks, which take time and passed when the planner was created.
        where = lambda planner: planner.obstacles.clutter  # noqa: E731
        loop.planner = eqx.tree_at(where, self.planner, clutter, is_leaf=lambda leaf: leaf is None)
        return loop

    @property
    def observations(self) -> Observations:
        """Observations after the last view.

        **Raises:** `ValueError` before the first view.
        """
        if self._observations is None:
            raise InputError("there is no view yet: add one first")
        return self._observations

    @own_settings()
    def add(self, pose: Pose, scan: PointCloud, on_accept: Callable[[], None] = lambda: None) -> View:
        """Add a view. If `propose` was called since the last view, the view records that proposal.

        - `pose`: actual pose of the sensor, which may differ from the proposed pose.
        - `on_accept`: function that is called after all checks and before the view is added, for example to store it.

        **Raises:** `ValueError` whenever `Planner.init` or `Planner.observe` raises it. The loop does not change then.
        """
        if self._observations is None:
            observations = self.planner.init(pose, scan, self.camera)
        else:
            observations = self.planner.observe(self._observations, pose, scan, self.camera)
        on_accept()
        proposal = self._next.proposal if self._next.is_proposed else None
        if self._first_view_time is None:
            self._first_view_time = time.monotonic()
        if proposal is not None:
            self._pending = self._pending.append(proposal.pose)
        view = View(pose, scan, observations.cloud, proposal, self.camera, observations.hypotheses)
        self._observations, self.views = observations, (*self.views, view)
        self._next = _StepState()
        return view

    @own_settings()
    def take(self, sensor: Sensor, first: Pose) -> Step | None:
        """Take the next view and add it. Return its step, or None if the stop rule has ended the episode.

        The first view is taken at `first`, the others at the proposed poses.

        **Raises:** `ValueError` whenever `propose` or `add` raises it.
        """
        pose, inputs, seconds = first, None, 0.0
        if self.views:
            if self.done() is not None:
                return None
            pose, seconds = self.propose().pose, self._next.seconds
            inputs = self._next.inputs if self.planner.search.uses_samples else None
        self._on_stage(STAGES[2])
        *_, noise_key = view_keys(self.key, len(self.views))
        view = self.add(pose, sensor(pose, noise_key))
        return Step(view, self.observations, inputs, seconds)

    def steps(
        self, sensor: Sensor, first: Pose, stored_views: Iterable[tuple[Pose, PointCloud, Proposal | None]] = ()
    ) -> Iterator[Step]:
        """Take views until the stop rule holds or `max_views` is reached, and yield the step of each view.

        - `stored_views`: stored views of the episode, in order. They are added first, without the sensor.

        **Raises:** `ValueError` whenever `take` raises it, for example when every candidate has been visited.
        """
        for pose, scan, proposal in stored_views:
            if proposal is not None:
                self.set_stored_proposal(proposal)
            yield Step(self.add(pose, scan), self.observations, None, 0.0)
        while len(self.views) < self.planner.max_views and (step := self.take(sensor, first)) is not None:
            yield step
            # A posterior may be large, so it is freed before the next step computes a new one.
            del step

    @own_settings()
    def propose(self) -> Proposal:
        """Return the proposal for the next view. The proposal stays the same until a view is added.

        **Raises:** `ValueError` before the first view, and whenever `Planner.propose` raises it.
        """
        self._next.is_proposed = True
        return self._next_proposal()

    def _next_proposal(self) -> Proposal:
        if self._next.proposal is None:
            inputs = self.inputs()
            self._on_stage(STAGES[1])
            start = time.perf_counter()
            _, search_key, _ = view_keys(self.key, len(self.views))
            proposal = self.planner.choose(inputs, search_key, self._pending)
            self._next.proposal, self._next.seconds = jax.block_until_ready(proposal), time.perf_counter() - start
        return self._next.proposal

    def replace_proposal(self, proposal: Proposal) -> None:
        """Use this proposal for the next view instead of the search's."""
        self._next.proposal = proposal

    def set_stored_proposal(self, proposal: Proposal) -> None:
        """Use a stored proposal for the next view, without a search."""
        self._next = _StepState(proposal=proposal, is_proposed=True)

    def inputs(self) -> StepInputs:
        """Return the inputs of the search for the next view. They are computed once for each view."""
        return self._sample_inputs() if self.planner.search.uses_samples else StepInputs(self.observations)

    @own_settings()
    def done(self) -> str | None:
        """Return the stop rule's reason to stop; None to continue.

        The rule is evaluated once for each view. `propose` reuses any samples and proposal that the rule computed.

        **Raises:** `ValueError` if the rule needs the next proposal and `propose` raises it.
        """
        if self.until is None or self._first_view_time is None or not self.views:
            return None
        if not self._next.is_evaluated:
            key, *_ = view_keys(self.key, len(self.views))
            poses = tuple(view.pose for view in self.views)
            seconds = time.monotonic() - self._first_view_time
            context = StopContext(self.planner, self.observations, poses, seconds, key, self._surfaces, self.frame)
            self._next.stop = checked_reason(self.until, self.until.after(context))
            if self._next.stop is None and self.until.needs_proposal:
                proposal = self._next_proposal()
                reason = self.until.before(context, proposal.pose, self.in_world(proposal.value))
                self._next.stop = checked_reason(self.until, reason)
            self._next.is_evaluated = True
        return self._next.stop

    @property
    def stop_reason(self) -> str | None:
        """Reason that `done` returned since the last view; None if it returned None or was not called."""
        return self._next.stop

    def in_world(self, value: Float[Array, ""]) -> float:
        """Convert a value of the search, or its standard error, to world units."""
        return float(self.frame.length_to_world(value, self.planner.quantity.length_power))

    def _surfaces(self) -> GridSurface:
        surfaces = self._sample_inputs().surfaces
        assert surfaces is not None
        return surfaces

    def _sample_inputs(self) -> StepInputs:
        if self._next.inputs is None:
            self._on_stage(STAGES[0])
            sample_key, *_ = view_keys(self.key, len(self.views))
            self._next.inputs = jax.block_until_ready(self.planner.sample_inputs(self.observations, sample_key))
        return self._next.inputs


def view_keys(key: PRNGKeyArray, index: int | Int[Array, ""]) -> tuple[PRNGKeyArray, PRNGKeyArray, PRNGKeyArray]:
    """Return three random keys for view `index` (from 0): for posterior samples, search and sensor noise."""
    return _view_keys(key, index if isinstance(index, Array) else np.int32(index))


@program
def _view_keys(key: PRNGKeyArray, index: Int[AnyArray, ""]) -> tuple[PRNGKeyArray, PRNGKeyArray, PRNGKeyArray]:
    step_key, noise_key = jax.random.split(jax.random.fold_in(key, index))
    sample_key, search_key = jax.random.split(step_key)
    return sample_key, search_key, noise_key
