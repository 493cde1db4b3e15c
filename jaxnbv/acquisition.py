"""From imagined scans to the value of a pose: the paper's acquisition functions.

    alpha(theta) = E alpha(D, scan(theta; f | D)),   estimated by the mean over the step's samples f_1, ..., f_S,

the same samples for all poses (common random numbers). An acquisition computes its context once from what has been
seen, and from that the *score* of each imagined view.
"""

from abc import abstractmethod
from typing import Any, ClassVar, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxnbv.checks import InputError, check_fields, checked, functions_of_users, is_traced, require, returned, shown
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud, concatenate, limit_capacity
from jaxnbv.geometry.pose import Pose
from jaxnbv.observations import Observations, as_observations
from jaxnbv.sampler import StepInputs
from jaxnbv.scanning import GridSurface, Surface, scan
from jaxnbv.scanning.grid import samples_at_once
from jaxnbv.sharding import batched_map, share_of, shared, shared_map
from jaxnbv.utility import Answer, AnyUtility, Quantity, Utility, as_utility, default_batch_size, plain_function


class ImaginedView(eqx.Module):
    """One imagined scan (rows, masked, in scene coordinates), the camera that takes it, and from which pose."""

    scan: PointCloud
    camera: Camera
    pose: Pose


class Acquisition(eqx.Module):
    """What one imagined scan is worth, given what has been seen. A search maximises the mean over the posterior.

    - `needs_posterior`: whether `context` looks at the posterior, which a planner then puts into the step.
    - `cloud_only`: whether `context` looks at D alone, so that a planner can try it before there are observations.
    - `measurable_only`: whether surface that a view looked at in vain is left out of the samples, see `Looks`.
    - `needs_hypotheses`: whether it is about the hypotheses that a model of known parts carries, and looks at no
      posterior; the step's only sample is then the likeliest part.
    - `gains_once`: whether a pose that was taken has nothing more to give, so that what is expected there is expected
      in vain. A search over candidates then takes the farthest from the cameras so far among those that are level with
      the best, see `Proposal.tied_with_best`.
    """

    needs_posterior: ClassVar[bool] = False
    cloud_only: ClassVar[bool] = False
    measurable_only: ClassVar[bool] = False
    gains_once: ClassVar[bool] = False
    needs_hypotheses: ClassVar[bool] = False

    @abstractmethod
    def context(self, step: StepInputs) -> Any:
        """Whatever depends on what has been seen alone; computed once a step."""

    @abstractmethod
    def score(self, context: Any, view: ImaginedView) -> Float[Array, "*values"]:
        """The score of one view. Finite; for a scan that sees nothing, no more than for any other."""

    def sample_scores(
        self,
        context: Any,
        surfaces: GridSurface,
        camera: Camera,
        poses: Pose,
        barrier: Float[Array, "poses rays"] | None = None,
    ) -> Float[Array, "samples poses *scores"]:
        """The score of what each of the sampled surfaces would show from each of a batch of poses. One row will do for
        an acquisition that is no mean over samples.

        All poses are scanned at once, of one sample or of `samples_at_once`, so memory is that of these scans; they are
        scored `batch_size` of them at a time. Samples are shared among devices, or the poses are where samples are too
        few.

        - `barrier`: see `scan`.
        """
        together = min(samples_at_once(camera, poses), share_of(surfaces.values.shape[0]))
        views = poses, barrier
        return shared_map(_of_sample, surfaces, context, views, self, camera, together, at_once=together)

    def inputs(self, step: StepInputs) -> StepInputs:
        """The part of a step that `context` looks at. Steps whose parts have equal shapes share one compilation."""
        if self.cloud_only:
            return inputs_of(step.observations.cloud)
        return StepInputs(step.observations, step.posterior if self.needs_posterior else None)

    @property
    def batch_size(self) -> int:
        """How many scans are scored together."""
        return default_batch_size()

    @property
    def quantity(self) -> Quantity:
        """What its expected value is."""
        meaning = "value of an imagined scan, mean over posterior samples."
        return Quantity(f"acquisition, {type(self).__name__}", "", meaning)

    def answer(self, cloud: PointCloud) -> Answer | None:
        """What D answers to what the acquisition asks; None where it has no answer."""
        return None

    def answer_values(self, cloud: PointCloud) -> Float[Array, " n"] | None:
        """The values of `answer`, made of JAX operations; None where there are none, or only host code has them."""
        return None

    def true_answer(self, scene: Surface, cloud: PointCloud) -> Answer | None:
        """What `answer` should come to in the end; None where that is not known.

        - `scene`: the true surface; `cloud`: points all over it, uniform by area.
        """
        return self.answer(cloud)

    def check(self, cloud: PointCloud) -> None:
        """Raise `ValueError` if what the acquisition is made of gives something impossible on a cloud: the first D, and
        D with a scan whose score is no finite number."""
        return


class ExpectedUtilityImprovement(Acquisition):
    """max(0, u(D u scan) - u(D)) for any utility u(cloud): the paper's alpha^(u), once averaged over samples.

    - `utility`: a `Utility`, or a function from a `PointCloud` (rows, masked) to a scalar, made of JAX operations.
    - `num_points`: where given, D is thinned to so many by farthest point sampling, once a step, before scans are
      added to it: for a utility that looks at so many points anyway, and would sample D again for every scan.
    """

    cloud_only: ClassVar[bool] = True
    utility: AnyUtility = eqx.field(converter=as_utility)
    num_points: int | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        check_fields(self)
        require(self.num_points is None or self.num_points >= 1, f"num_points is {self.num_points}; give at least 1")

    def context(self, step: StepInputs) -> tuple[PointCloud, Array]:
        """D, thinned, and u(D)."""
        cloud = step.observations.cloud
        cloud = cloud if self.num_points is None else limit_capacity(cloud, self.num_points)
        return cloud, self._value(cloud)

    def _value(self, cloud: PointCloud) -> Any:
        return returned(self.utility(cloud), f"the {self.utility.name} of a cloud", 0, "a utility is one number")

    def score(self, context: tuple[PointCloud, Float[Array, ""]], view: ImaginedView) -> Float[Array, ""]:
        """max(0, u(D u scan) - u(D))."""
        cloud, utility = context
        return zero_if_empty(view.scan, jnp.maximum(0.0, self._value(concatenate(cloud, view.scan)) - utility))

    @property
    def batch_size(self) -> int:
        """As the utility prefers."""
        return self.utility.batch_size

    @property
    def quantity(self) -> Quantity:
        """The utility's `improvement`."""
        return self.utility.improvement

    def answer(self, cloud: PointCloud) -> Answer:
        """The utility's own answer, or its value."""
        own = self.utility.answer(cloud)
        return Answer((self.utility.name,), np.array([float(context_of(self, cloud)[1])])) if own is None else own

    def answer_values(self, cloud: PointCloud) -> Float[Array, " n"] | None:
        """The utility's own, or its value."""
        own = self.utility.answer_values(cloud)
        if own is None and type(self.utility).answer is Utility.answer:
            return jnp.atleast_1d(context_of(self, cloud)[1])
        return own

    def true_answer(self, scene: Surface, cloud: PointCloud) -> Answer:
        """The utility's own, or its answer on all of the surface."""
        own = self.utility.true_answer(scene, cloud)
        return self.answer(cloud) if own is None else own

    def check(self, cloud: PointCloud) -> None:
        """**Raises:** `ValueError` as the utility's own `check` does, or if u(D) is not a finite number."""
        self.utility.check(cloud)
        _, value = context_of(self, cloud)
        name, count = self.utility.name, int(cloud.count)
        require(bool(jnp.isfinite(value)), f"the {name} of a cloud of {count} points is {value}: it must be finite")


def as_acquisition(value: Any) -> Acquisition:
    """An acquisition as it is; the expected improvement of a utility, or of a plain function as one.

    **Raises:** `ValueError` for anything else.
    """
    if isinstance(value, Acquisition):
        return value
    return ExpectedUtilityImprovement(plain_function(value, "the acquisition", ", such as Coverage()"))


class AcquisitionList(Acquisition):
    """Several acquisitions of the same scans: compared on the same samples, at the cost of one scan.

    Its value is a vector, the members' values in their order (a member whose value is a vector itself takes as many
    places): for `expected_value` and `Problem.scores`, not for a planner.
    """

    members: tuple[Acquisition, ...]

    def __check_init__(self):
        known = isinstance(self.members, tuple) and all(isinstance(member, Acquisition) for member in self.members)
        require(known and len(self.members) > 0, f"the members are {shown(self.members)}; give a tuple of some")

    @property
    def needs_posterior(self) -> bool:  # type: ignore[override]
        """Whether one of them does."""
        return any(member.needs_posterior for member in self.members)

    def context(self, step: StepInputs) -> tuple[Any, ...]:
        """That of each."""
        return tuple(member.context(member.inputs(step)) for member in self.members)

    def score(self, context: tuple[Any, ...], view: ImaginedView) -> Float[Array, " values"]:
        """The scores of one view."""
        values = [member.score(own, view) for member, own in zip(self.members, context, strict=True)]
        return jnp.concatenate([jnp.atleast_1d(value) for value in values])

    @property
    def batch_size(self) -> int:
        """The least that one prefers."""
        return min(member.batch_size for member in self.members)

    def check(self, cloud: PointCloud) -> None:
        """**Raises:** `ValueError` as one of them does."""
        for member in self.members:
            member.check(cloud)


def inputs_of(seen: StepInputs | Observations | PointCloud) -> StepInputs:
    """A step's inputs as they are; observations, or a cloud alone, as inputs without posterior and samples."""
    return seen if isinstance(seen, StepInputs) else StepInputs(as_observations(seen))


def context_of(acquisition: Acquisition, seen: StepInputs | Observations | PointCloud) -> Any:
    """The acquisition's context, compiled.

    **Raises:** `ValueError` for a function of the user's that JAX cannot trace, and if the acquisition needs a
    posterior and there is none.
    """
    inputs = _inputs(acquisition, seen)
    with functions_of_users():
        return _context_of(acquisition, inputs)


def _inputs(acquisition: Acquisition, seen: StepInputs | Observations | PointCloud) -> StepInputs:
    step = inputs_of(seen)
    require(
        step.posterior is not None or not acquisition.needs_posterior,
        f"{type(acquisition).__name__} needs the posterior: give StepInputs(observations, posterior)",
    )
    return acquisition.inputs(step)


@eqx.filter_jit
def _context_of(acquisition: Acquisition, inputs: StepInputs) -> Any:
    return acquisition.context(inputs)


def zero_if_empty(scan: PointCloud, value: Float[Array, "*values"]) -> Float[Array, "*values"]:
    """The value, or values, or zero for a scan that sees nothing."""
    return jnp.where(jnp.any(scan.mask), value, 0.0)


def check_traceable(
    acquisition: Acquisition, seen: Observations | int, camera: Camera, differentiable: bool = False
) -> None:
    """Check that JAX can trace an acquisition, by shapes alone: nothing is computed.

    - `seen`: observations, or the capacity of a cloud D.
    - `camera`: whose scans it scores.
    - `differentiable`: whether it must have derivatives in the points and normals of a scan.

    **Raises:** `ValueError` if it cannot, as for a utility of NumPy, or derivatives of what calls back to host code.
    """
    if acquisition.needs_posterior or acquisition.needs_hypotheses:
        # There are none yet.
        return

    def cloud(rows: int) -> PointCloud:
        return PointCloud(jnp.zeros((rows, 3)), jnp.ones((rows, 3)), jnp.ones(rows, bool))

    def value(rows):
        points, normals = rows
        scan, pose = PointCloud(points, normals, cloud(camera.num_rays).mask), Pose(jnp.eye(3), jnp.zeros(3))
        step = inputs_of(cloud(seen) if isinstance(seen, int) else seen)
        return acquisition.score(acquisition.context(acquisition.inputs(step)), ImaginedView(scan, camera, pose))

    rows = cloud(camera.num_rays).points, cloud(camera.num_rays).normals
    with functions_of_users():
        jax.eval_shape(value, rows)
    if not differentiable:
        return
    try:
        jax.eval_shape(jax.grad(value), rows)
    except ValueError as error:
        raise InputError(
            f"{type(acquisition).__name__} cannot be differentiated, so no gradient search can use it ({error}). "
            "Use DiscreteSearch, which asks for values only"
        ) from error


@checked
def expected_value(
    acquisition: Acquisition,
    seen: StepInputs | Observations | PointCloud,
    surfaces: GridSurface,
    camera: Camera,
    poses: Pose,
    barrier: Float[Array, "poses rays"] | None = None,
) -> Float[Array, "poses *scores"]:
    """The acquisition at each of a batch of poses: mean over the sampled surfaces of the score of what they would show.

    Runs under `jit`, `grad` and `vmap`, in the poses and in what has been seen.

    - `seen`: a cloud D suffices for all acquisitions but those that need the posterior, which `StepInputs` holds.
    - `surfaces`: the samples along a leading axis.
    - `barrier`: see `scan`.

    The members of `AcquisitionList` have an axis of their own.

    **Raises:** `ValueError` as the acquisition's `check` does, where values are known, and for a function of the user's
    that JAX cannot trace.
    """
    inputs = _inputs(acquisition, seen)
    # Under jit even what follows from known values is traced, so there is nothing that a check could look at.
    if not is_traced(acquisition, inputs, jnp.zeros(())):
        acquisition.check(inputs.observations.cloud)
    with functions_of_users():
        context = acquisition.context(inputs)
        return jnp.mean(acquisition.sample_scores(context, surfaces, camera, poses, barrier), axis=0)


def scores(
    acquisition: Acquisition, context: Any, scans: PointCloud, camera: Camera, poses: Pose, samples: int = 1
) -> Float[Array, "poses *scores"]:
    """The score of each of a batch of scans, one from each of a batch of poses, `batch_size` of them at a time; fewer
    where several samples are scored together.
    """
    return batched_map(
        lambda rows: acquisition.score(context, ImaginedView(rows[0], camera, rows[1])),
        (scans, poses),
        acquisition.batch_size // samples,
    )


# Poses, and how far along the rays from each obstacles stand.
_Views: TypeAlias = tuple[Pose, Float[Array, "poses rays"] | None]


def _of_sample(
    surface: GridSurface, context: Any, views: _Views, acquisition: Acquisition, camera: Camera, together: int
) -> Float[Array, "poses *scores"]:
    return shared(_of_poses, views, surface, context, acquisition, camera, together)


def _of_poses(
    views: _Views, surface: GridSurface, context: Any, acquisition: Acquisition, camera: Camera, together: int
) -> Float[Array, "poses *scores"]:
    poses, barrier = views
    return scores(acquisition, context, scan(surface, camera, poses, barrier), camera, poses, together)
