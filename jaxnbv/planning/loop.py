"""The loop that every episode is: ask for a pose, take the view, tell what it showed, ask whether that is enough.

A simulation, a study and a session at a real sensor drive the same `Loop`, which keeps all that depends on the views so
far: the observations, what was proposed, the keys, the clock and the rule that ends it.
"""

import copy
import dataclasses
import time
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple, TypeAlias

import equinox as eqx
import jax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from jaxnbv.acquisition import Acquisition
from jaxnbv.checks import InputError, own_settings
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.pose_list import PoseList
from jaxnbv.observations import Observations
from jaxnbv.planning.planner import Planner
from jaxnbv.planning.stopping import StopContext, StopRule, checked_reason
from jaxnbv.sampler import StepInputs
from jaxnbv.scanning import GridSurface
from jaxnbv.scanning.sdf import SignedDistance
from jaxnbv.search import Proposal
from jaxnbv.surfaces.part_hypotheses import PartHypotheses
from jaxnbv.tasks.identification import identity_answer
from jaxnbv.utility import Answer

Sensor: TypeAlias = Callable[[Pose, PRNGKeyArray], PointCloud]
"""What a sensor sees from a pose; the key is of its noise, for which a real sensor has no use."""

STAGES = ("sampling surfaces", "searching", "scanning")


class View(eqx.Module):
    """One view of an episode, in scene coordinates.

    - `pose`: where the sensor was.
    - `scan`: what it saw, noise included; one row a pixel.
    - `cloud`: D after this view.
    - `proposal`: what the search looked at; None for the first view, which was given.
    - `camera`: the one that took it, in scene units.
    - `hypotheses`: what the model carries after this view, see `Observations`.
    """

    pose: Pose
    scan: PointCloud
    cloud: PointCloud
    proposal: Proposal | None
    camera: Camera
    hypotheses: eqx.Module | None = None

    def answer(self, acquisition: Acquisition) -> Answer | None:
        """What the views so far answer to what an acquisition asks; which part the object is, where it has no answer of
        its own and parts are known."""
        answer = acquisition.answer(self.cloud)
        if answer is None and isinstance(self.hypotheses, PartHypotheses):
            return identity_answer(self.hypotheses, acquisition)
        return answer


class Step(NamedTuple):
    """How an episode came to a view.

    - `observations`: after the view.
    - `inputs`: the samples that the view was chosen by; None where there are none, and for a view that was given or
      stored.
    - `seconds`: of the search; zero for a view that was given or stored.
    """

    view: View
    observations: Observations
    inputs: StepInputs | None
    seconds: float


@dataclasses.dataclass
class _StepState:
    """What was computed for the next view so far.

    - `is_proposed`: whether the proposal was handed out, and not computed for the rule alone.
    - `stop`: why the view is not needed, once the rule `is_asked`.
    """

    inputs: StepInputs | None = None
    proposal: Proposal | None = None
    is_proposed: bool = False
    seconds: float = 0.0
    stop: str | None = None
    is_asked: bool = False


class Loop:
    """An episode as it goes on. What was taken and what is proposed are told apart: travel, and the distance to earlier
    cameras, count from poses that were taken; a pose that was proposed is not proposed again, whether it was taken.

    - `planner`: plans, in scene coordinates.
    - `key`: view i depends on it and on i alone.
    - `until`: the rule that ends the episode; None for no end.
    - `frame`: of the user's world, in whose units the rule is asked.
    - `camera`: the sensor's, in scene units, by default the planner's.
    - `begin`: is called with each of `STAGES` as it begins.

    **Raises:** `ValueError` if the rule does not apply to the planner's acquisition.
    """

    @own_settings()
    def __init__(
        self,
        planner: Planner,
        key: PRNGKeyArray,
        until: StopRule | None = None,
        frame: Frame = Frame(),  # noqa: B008
        camera: Camera | None = None,
        begin: Callable[[str], None] = lambda stage: None,
    ):
        if until is not None:
            until.check(planner.acquisition)
        self.planner, self.key, self.until, self.frame = planner, key, until, frame
        self.camera, self._begin = planner.camera if camera is None else camera, begin
        self.views: tuple[View, ...] = ()
        self._observations: Observations | None = None
        self._pending = PoseList.empty(planner.max_views)
        self._first_view_at: float | None = None
        self._next = _StepState()

    def emptied(self, planner: Planner) -> "Loop":
        """Without its views, by a planner that may be another: to add them again. The clock goes on."""
        loop = copy.copy(self)
        loop.planner, loop.views, loop._observations = planner, (), None
        loop._pending, loop._next = PoseList.empty(planner.max_views), _StepState()
        return loop

    def with_clutter(self, clutter: SignedDistance | None) -> "Loop":
        """With other clutter among the planner's obstacles, in scene units; None for none."""
        assert self.planner.obstacles is not None
        loop = copy.copy(self)
        # The planner is checked already, which takes time.
        where = lambda planner: planner.obstacles.clutter  # noqa: E731
        loop.planner = eqx.tree_at(where, self.planner, clutter, is_leaf=lambda leaf: leaf is None)
        return loop

    @property
    def observations(self) -> Observations:
        """After the last view.

        **Raises:** `ValueError` before the first view.
        """
        if self._observations is None:
            raise InputError("there is no view yet: add one first")
        return self._observations

    @own_settings()
    def add(self, pose: Pose, scan: PointCloud, accepted: Callable[[], None] = lambda: None) -> View:
        """Add a view that was taken, wherever that was; its proposal is what `propose` gave since the last view, if it
        was asked.

        - `accepted`: is called before the view is added, once nothing can refuse it: to store it.

        **Raises:** `ValueError` as `Planner.init` and `Planner.observe` do; the loop is unchanged then.
        """
        if self._observations is None:
            observations = self.planner.init(pose, scan, self.camera)
        else:
            observations = self.planner.observe(self._observations, pose, scan, self.camera)
        accepted()
        proposal = self._next.proposal if self._next.is_proposed else None
        if self._first_view_at is None:
            self._first_view_at = time.monotonic()
        if proposal is not None:
            self._pending = self._pending.append(proposal.pose)
        view = View(pose, scan, observations.cloud, proposal, self.camera, observations.hypotheses)
        self._observations, self.views = observations, (*self.views, view)
        self._next = _StepState()
        return view

    @own_settings()
    def take(self, sensor: Sensor, first: Pose) -> Step | None:
        """Take the next view by a sensor, from where the planner asks for it, and add it; None once the views are
        enough.

        - `first`: the pose of the first view.

        **Raises:** `ValueError` as `propose` and `add` do.
        """
        pose, inputs, seconds = first, None, 0.0
        if self.views:
            if self.enough() is not None:
                return None
            pose, seconds = self.propose().pose, self._next.seconds
            inputs = self._next.inputs if self.planner.search.uses_samples else None
        self._begin(STAGES[2])
        *_, noise_key = view_keys(self.key, len(self.views))
        view = self.add(pose, sensor(pose, noise_key))
        return Step(view, self.observations, inputs, seconds)

    def steps(
        self, sensor: Sensor, first: Pose, stored: Iterable[tuple[Pose, PointCloud, Proposal | None]] = ()
    ) -> Iterator[Step]:
        """Views from `first` on, for as long as more are wanted, they are not enough, and the planner has room.

        - `stored`: views that were taken before, in their order: they are added first, and the sensor not asked.

        **Raises:** `ValueError` as `take` does; among others when every candidate has been visited.
        """
        for pose, scan, proposal in stored:
            if proposal is not None:
                self.resume(proposal)
            yield Step(self.add(pose, scan), self.observations, None, 0.0)
        while len(self.views) < self.planner.max_views and (step := self.take(sensor, first)) is not None:
            yield step
            # The posterior of a step may be large, and is not to be held beside that of the next.
            del step

    @own_settings()
    def propose(self) -> Proposal:
        """The next pose and what the search looked at: the same until a view is added.

        **Raises:** `ValueError` before the first view, and as `Planner.propose` does.
        """
        self._next.is_proposed = True
        return self._chosen()

    def _chosen(self) -> Proposal:
        if self._next.proposal is None:
            inputs = self.inputs()
            self._begin(STAGES[1])
            start = time.perf_counter()
            _, search_key, _ = view_keys(self.key, len(self.views))
            proposal = self.planner.choose(inputs, search_key, self._pending)
            self._next.proposal, self._next.seconds = jax.block_until_ready(proposal), time.perf_counter() - start
        return self._next.proposal

    def settle(self, proposal: Proposal) -> None:
        """Take a proposal in place of the one that the search gave from the same samples."""
        self._next.proposal = proposal

    def resume(self, proposal: Proposal) -> None:
        """Take a stored proposal for that of the next view."""
        self._next = _StepState(proposal=proposal, is_proposed=True)

    def inputs(self) -> StepInputs:
        """What the search of the next view looks at, computed once."""
        if not self.planner.search.uses_samples:
            return StepInputs(self.observations)
        return self._sampled()

    @own_settings()
    def enough(self) -> str | None:
        """Why no more views are needed, by the rule; None while they are. Costs what the rule looks at, once a view:
        the samples and the proposal that it asks for are those of `propose`.

        **Raises:** `ValueError` as `propose` does, where the rule is about the next view.
        """
        if self.until is None or self._first_view_at is None or not self.views:
            return None
        if not self._next.is_asked:
            key, *_ = view_keys(self.key, len(self.views))
            poses = tuple(view.pose for view in self.views)
            seconds = time.monotonic() - self._first_view_at
            context = StopContext(self.planner, self.observations, poses, seconds, key, self._surfaces, self.frame)
            self._next.stop = checked_reason(self.until, self.until.after(context))
            if self._next.stop is None and self.until.needs_proposal:
                proposal = self._chosen()
                reason = self.until.before(context, proposal.pose, self.in_world(proposal.value))
                self._next.stop = checked_reason(self.until, reason)
            self._next.is_asked = True
        return self._next.stop

    @property
    def stopped(self) -> str | None:
        """Why no more views are needed, as far as the rule was asked."""
        return self._next.stop

    def in_world(self, value: Float[Array, ""]) -> float:
        """A value of the search, or its error, with lengths in world units."""
        return float(self.frame.length_to_world(value, self.planner.quantity.length_power))

    def _surfaces(self) -> GridSurface:
        surfaces = self._sampled().surfaces
        assert surfaces is not None
        return surfaces

    def _sampled(self) -> StepInputs:
        if self._next.inputs is None:
            self._begin(STAGES[0])
            sample_key, *_ = view_keys(self.key, len(self.views))
            self._next.inputs = jax.block_until_ready(self.planner.sampled(self.observations, sample_key))
        return self._next.inputs


def view_keys(key: PRNGKeyArray, index: int | Int[Array, ""]) -> tuple[PRNGKeyArray, PRNGKeyArray, PRNGKeyArray]:
    """Keys of view `index` (from 0) of an episode: of its posterior samples, its search and its sensor's noise."""
    step_key, noise_key = jax.random.split(jax.random.fold_in(key, index))
    sample_key, search_key = jax.random.split(step_key)
    return sample_key, search_key, noise_key
