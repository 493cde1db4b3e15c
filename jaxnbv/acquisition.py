"""Acquisition functions of the paper: the value of a pose, computed from imagined scans.

    alpha(theta) = E alpha(D, scan(theta; f | D)),   estimated by the mean over the step's samples f_1, ..., f_S

Here theta is a pose, D the cloud of all scans so far, and f a surface of the posterior given D. All poses use the same
samples (common random numbers). An acquisition computes its *context* from the observations once per step, and the
*score* of each imagined view from the context.
"""

from abc import abstractmethod
from typing import Any, ClassVar, TypeAlias

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxnbv.checks import check_fields, checked, checked_result, functions_of_users, is_traced, require, short_text
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud, concatenate, limit_capacity
from jaxnbv.geometry.pose import Pose
from jaxnbv.observations import Observations, as_observations
from jaxnbv.programs import program
from jaxnbv.sampler import StepInputs
from jaxnbv.scanning import GridSurface, Surface, scan
from jaxnbv.scanning.grid import samples_at_once
from jaxnbv.sharding import batched_map, rows_per_device, run_sharded, shared_map
from jaxnbv.utility import Answer, AnyUtility, Quantity, Utility, as_utility, default_batch_size, plain_function


class ImaginedView(eqx.Module):
    """One imagined scan, in scene coordinates, with its camera and its pose."""

    scan: PointCloud
    camera: Camera
    pose: Pose


class Acquisition(eqx.Module):
    """Base class of acquisitions: the score of one imagined scan, given the observations.

    A search maximises the mean score over the samples.

    - `needs_posterior`: whether `context` reads the posterior. If not, `inputs` leaves it out.
    - `cloud_only`: whether `context` reads only the cloud D. A planner can then test the acquisition before any view.
    - `measurable_only`: whether a planner removes sampled surface that an earlier view should have measured, but did
      not (see `Looks`).
    - `needs_hypotheses`: whether `context` reads the hypotheses of a model of known parts, and no posterior. The most
      likely part is then the only sample of the step.
    - `gains_once`: whether a second view from the same pose gains nothing. The true value at a visited pose is then
      zero, so the estimated value there shows how large estimation errors are. `DiscreteSearch` treats candidates as
      tied if their values differ by no more than such errors.
    """

    needs_posterior: ClassVar[bool] = False
    cloud_only: ClassVar[bool] = False
    measurable_only: ClassVar[bool] = False
    gains_once: ClassVar[bool] = False
    needs_hypotheses: ClassVar[bool] = False

    @abstractmethod
    def context(self, step: StepInputs) -> Any:
        """Compute everything that `score` needs besides the view. Called once per step."""

    @abstractmethod
    def score(self, context: Any, view: ImaginedView) -> Float[Array, "*values"]:
        """Return the finite score of one view. No scan may score lower than an empty scan."""

    def sample_scores(
        self,
        context: Any,
        surfaces: GridSurface,
        camera: Camera,
        poses: Pose,
        barrier: Float[Array, "poses rays"] | None = None,
    ) -> Float[Array, "samples poses *scores"]:
        """Return the scores of imagined scans: one scan of each sampled surface from each pose.

        An acquisition whose value is not a mean over samples, such as `Identify`, may return a single row. Devices
        share the samples, or the poses if there are fewer samples than devices. Each device scans several samples
        together from all poses (see `samples_at_once`), and scores `batch_size` scans together.

        - `barrier`: for each pose, the distance along each ray to the first obstacle, see `scan`.
        """
        samples_per_batch = min(samples_at_once(camera, poses), rows_per_device(surfaces.values.shape[0]))
        views = poses, barrier
        return shared_map(
            _score_sample, surfaces, context, views, self, camera, samples_per_batch, at_once=samples_per_batch
        )

    def inputs(self, step: StepInputs) -> StepInputs:
        """Return only the inputs that `context` reads.

        `context` is then not compiled again if another input changes its shape.
        """
        if self.cloud_only:
            return inputs_of(step.observations.cloud)
        return StepInputs(step.observations, step.posterior if self.needs_posterior else None)

    @property
    def batch_size(self) -> int:
        """Number of scans to score together."""
        return default_batch_size()

    @property
    def quantity(self) -> Quantity:
        """Name, unit and meaning of the acquisition's expected value."""
        meaning = "value of an imagined scan, mean over posterior samples."
        return Quantity(f"acquisition, {type(self).__name__}", "", meaning)

    def answer(self, cloud: PointCloud) -> Answer | None:
        """Return the answer to the task's question given a cloud, for example the probability of each class.

        The default is None: the task has no question that a cloud answers, as for `NewSurface`.
        """
        return None

    def answer_values(self, cloud: PointCloud) -> Float[Array, " n"] | None:
        """Return `answer(cloud).values`, computed by JAX; None if there is no answer or JAX cannot compute it."""
        return None

    def true_answer(self, scene: Surface, cloud: PointCloud) -> Answer | None:
        """Return the correct answer for the true surface `scene`; None if it is unknown.

        - `cloud`: points on the whole true surface, uniform by area. By default `answer(cloud)` counts as correct.
        """
        return self.answer(cloud)

    def check(self, cloud: PointCloud) -> None:
        """Raise `ValueError` if a network or function of the acquisition returns an invalid result.

        - `cloud`: the cloud D; or, to explain a score that is not finite, D with the scan that got it.
        """
        return


class ExpectedUtilityImprovement(Acquisition):
    """Acquisition whose score is max(0, u(D + scan) - u(D)), the gain of a utility u by a scan.

    D + scan is the cloud D with the scan's points added. The mean score over samples is the paper's alpha^(u).

    - `utility`: a `Utility`, or a function from a `PointCloud` to a scalar, made of JAX operations. The function must
      leave out rows whose mask is False.
    - `num_points`: if not None, D is thinned to this number of points by farthest point sampling, once per step, before
      scans are added. Use it for a utility that would otherwise thin D to this number for every scan.
    """

    cloud_only: ClassVar[bool] = True
    utility: AnyUtility = eqx.field(converter=as_utility)
    num_points: int | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        check_fields(self)
        require(self.num_points is None or self.num_points >= 1, f"num_points is {self.num_points}; give at least 1")

    def context(self, step: StepInputs) -> tuple[PointCloud, Array]:
        """Return the cloud D, thinned to `num_points`, and its utility."""
        cloud = step.observations.cloud
        cloud = cloud if self.num_points is None else limit_capacity(cloud, self.num_points)
        return cloud, self._value(cloud)

    def _value(self, cloud: PointCloud) -> Any:
        return checked_result(self.utility(cloud), f"the {self.utility.name} of a cloud", 0, "a utility is one number")

    def score(self, context: tuple[PointCloud, Float[Array, ""]], view: ImaginedView) -> Float[Array, ""]:
        """Return how much the view's scan raises the utility of the cloud, or 0 if it lowers the utility."""
        cloud, utility = context
        return zero_if_empty(view.scan, jnp.maximum(0.0, self._value(concatenate(cloud, view.scan)) - utility))

    @property
    def batch_size(self) -> int:
        return self.utility.batch_size

    @property
    def quantity(self) -> Quantity:
        return self.utility.improvement

    def answer(self, cloud: PointCloud) -> Answer:
        """Return `utility.answer(cloud)`, or the utility of the cloud as a single number if that is None."""
        answer = self.utility.answer(cloud)
        return Answer((self.utility.name,), np.array([float(context_of(self, cloud)[1])])) if answer is None else answer

    def answer_values(self, cloud: PointCloud) -> Float[Array, " n"] | None:
        """Return `answer(cloud).values`, computed by JAX; None if JAX cannot compute the utility's own answer."""
        values = self.utility.answer_values(cloud)
        if values is None and type(self.utility).answer is Utility.answer:
            return jnp.atleast_1d(context_of(self, cloud)[1])
        return values

    def true_answer(self, scene: Surface, cloud: PointCloud) -> Answer:
        """Return `utility.true_answer(scene, cloud)`, or `answer(cloud)` if that is None."""
        answer = self.utility.true_answer(scene, cloud)
        return self.answer(cloud) if answer is None else answer

    def check(self, cloud: PointCloud) -> None:
        """Raise `ValueError` if the utility's `check` raises it, or if the cloud's utility is not finite."""
        self.utility.check(cloud)
        _, value = context_of(self, cloud)
        name, count = self.utility.name, int(cloud.count)
        require(bool(jnp.isfinite(value)), f"the {name} of a cloud of {count} points is {value}: it must be finite")


def as_acquisition(value: Any) -> Acquisition:
    """Return an acquisition unchanged; make `ExpectedUtilityImprovement` from a utility or function.

    **Raises:** `ValueError` for anything else.
    """
    if isinstance(value, Acquisition):
        return value
    return ExpectedUtilityImprovement(plain_function(value, "the acquisition", ", such as Coverage()"))


class AcquisitionList(Acquisition):
    """Several acquisitions that score the same scans, so each sample is scanned only once from each pose.

    The score is a vector, the concatenated scores of the `members`. Use an `AcquisitionList` with `expected_value` and
    `Problem.scores`, not in a planner.
    """

    members: tuple[Acquisition, ...]

    def __check_init__(self):
        is_valid = isinstance(self.members, tuple) and all(isinstance(member, Acquisition) for member in self.members)
        require(
            is_valid and len(self.members) > 0,
            f"the members are {short_text(self.members)}; give a tuple of acquisitions",
        )

    @property
    def needs_posterior(self) -> bool:  # type: ignore[override]
        """Whether any member needs the posterior."""
        return any(member.needs_posterior for member in self.members)

    def context(self, step: StepInputs) -> tuple[Any, ...]:
        return tuple(member.context(member.inputs(step)) for member in self.members)

    def score(self, context: tuple[Any, ...], view: ImaginedView) -> Float[Array, " values"]:
        pairs = zip(self.members, context, strict=True)
        return jnp.concatenate([jnp.atleast_1d(member.score(part, view)) for member, part in pairs])

    @property
    def batch_size(self) -> int:
        return min(member.batch_size for member in self.members)

    def check(self, cloud: PointCloud) -> None:
        for member in self.members:
            member.check(cloud)


def inputs_of(observations: StepInputs | Observations | PointCloud) -> StepInputs:
    """Return step inputs unchanged; convert observations or a cloud to step inputs without a posterior."""
    return observations if isinstance(observations, StepInputs) else StepInputs(as_observations(observations))


def context_of(acquisition: Acquisition, observations: StepInputs | Observations | PointCloud) -> Any:
    """Compute the acquisition's context for these observations, as a compiled program.

    **Raises:** `ValueError` if JAX cannot trace a user's function, or if a posterior is needed but missing.
    """
    inputs = _inputs(acquisition, observations)
    with functions_of_users():
        return _context_of(acquisition, inputs)


def _inputs(acquisition: Acquisition, observations: StepInputs | Observations | PointCloud) -> StepInputs:
    step = inputs_of(observations)
    require(
        step.posterior is not None or not acquisition.needs_posterior,
        f"{type(acquisition).__name__} needs the posterior: give StepInputs(observations, posterior)",
    )
    return acquisition.inputs(step)


@program
def _context_of(acquisition: Acquisition, inputs: StepInputs) -> Any:
    return acquisition.context(inputs)


def zero_if_empty(scan: PointCloud, value: Float[Array, "*values"]) -> Float[Array, "*values"]:
    """Return the values unchanged, or zero if the scan is empty."""
    return jnp.where(jnp.any(scan.mask), value, 0.0)


@checked
def expected_value(
    acquisition: Acquisition,
    observations: StepInputs | Observations | PointCloud,
    surfaces: GridSurface,
    camera: Camera,
    poses: Pose,
    barrier: Float[Array, "poses rays"] | None = None,
) -> Float[Array, "poses *scores"]:
    """Return the expected value at each pose: the mean score of imagined scans over the samples.

    Supports `jit`, `grad` and `vmap` over poses and observations. An `AcquisitionList` adds an axis for its members.

    - `observations`: the observations, or a cloud D. An acquisition that needs the posterior requires `StepInputs`.
    - `surfaces`: the samples along a leading axis.
    - `barrier`: for each pose, the distance along each ray to the first obstacle, see `scan`.

    **Raises:** `ValueError` if JAX cannot trace a user's function, if a posterior is needed but missing, or if
    `Acquisition.check` raises it. Under `jit`, `grad` or `vmap` this check is skipped.
    """
    inputs = _inputs(acquisition, observations)
    # `check` needs concrete results. Under jit, results (and this zero) are traced even if all inputs are concrete.
    if not is_traced(acquisition, inputs, jnp.zeros(())):
        acquisition.check(inputs.observations.cloud)
    with functions_of_users():
        context = acquisition.context(inputs)
        return jnp.mean(acquisition.sample_scores(context, surfaces, camera, poses, barrier), axis=0)


def scores(
    acquisition: Acquisition, context: Any, scans: PointCloud, camera: Camera, poses: Pose, samples_per_batch: int = 1
) -> Float[Array, "poses *scores"]:
    """Return the scores of a batch of scans, one scan from each pose.

    - `samples_per_batch`: number of samples for which the caller runs this function at the same time. Each of these
      runs scores `acquisition.batch_size // samples_per_batch` scans together.
    """
    return batched_map(
        lambda rows: acquisition.score(context, ImaginedView(rows[0], camera, rows[1])),
        (scans, poses),
        acquisition.batch_size // samples_per_batch,
    )


# Poses, and for each pose the distance along each ray to the first obstacle.
_Views: TypeAlias = tuple[Pose, Float[Array, "poses rays"] | None]


def _score_sample(
    surface: GridSurface, context: Any, views: _Views, acquisition: Acquisition, camera: Camera, samples_per_batch: int
) -> Float[Array, "poses *scores"]:
    return run_sharded(_score_poses, views, surface, context, acquisition, camera, samples_per_batch)


def _score_poses(
    views: _Views, surface: GridSurface, context: Any, acquisition: Acquisition, camera: Camera, samples_per_batch: int
) -> Float[Array, "poses *scores"]:
    poses, barrier = views
    return scores(acquisition, context, scan(surface, camera, poses, barrier), camera, poses, samples_per_batch)
