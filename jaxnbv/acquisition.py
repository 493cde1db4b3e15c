"""From imagined scans to the value of a pose: the paper's acquisition functions.

    alpha(theta) = E alpha(D, scan(theta; f | D)),   estimated by the mean over the step's samples f_1, ..., f_S,

the same samples for all poses (common random numbers). An acquisition sees the context that was computed once from D,
and one imagined scan; what it gives of it is that scan's *score*.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxnbv.checks import InputError, check_fields, checked, functions_of_users, is_traced, require, shown
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud, concatenate, limit_capacity
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.pose import Pose
from jaxnbv.scanning import GridSurface, Surface, scan
from jaxnbv.scanning.grid import samples_at_once
from jaxnbv.sharding import batched_map, on_cpu, share_of, shared, shared_map

_POWERS = {1: "", 2: "²", 3: "³"}


class Quantity(eqx.Module):
    """The name, unit and meaning of what is maximised, for tables and captions.

    - `name`, `unit`: in words; the unit is empty where there is none, and leaves out the power of length.
    - `meaning`: the rest of a caption that begins with "Value:".
    - `smooth`: whether values between two candidates mean anything.
    - `length_power`: power of length in the unit (2 for an area).
    """

    name: str
    unit: str
    meaning: str
    smooth: bool = True
    length_power: int = 0

    def unit_in(self, frame: Frame) -> str:
        """The whole unit in words, lengths in the units of a frame's world."""
        length = f"{frame.unit}{_POWERS.get(self.length_power, f'^{self.length_power}')}" if self.length_power else ""
        return f"{length} {self.unit}".strip()


class Answer(eqx.Module):
    """What the cloud D answers to the question: numbers with names. `jaxnbv.viz` puts them into words.

    - `names`, `values`: one each.
    - `form`: how a value is written, in the language of `str.format`.
    """

    names: tuple[str, ...]
    values: Float[np.ndarray, " n"]
    form: str = "{:.4g}"


class Acquisition(eqx.Module):
    """What one imagined scan is worth, given what has been seen. A search maximises the mean over the posterior."""

    @abstractmethod
    def context(self, cloud: PointCloud) -> Any:
        """Whatever depends on D alone; computed once a step."""

    def __call__(self, context: Any, scan: PointCloud) -> Float[Array, ""]:
        """The score of one scan (rows, masked). Finite; for a scan that sees nothing, no more than for any other.

        **Raises:** `ValueError` for an acquisition that has only a `score`.
        """
        name = type(self).__name__
        raise InputError(f"{name} scores no scan alone: call its score(context, scan, camera, pose)")

    def score(self, context: Any, scan: PointCloud, camera: Camera, pose: Pose) -> Float[Array, "*values"]:
        """The score of one scan that a camera takes from a pose: by default that of the scan alone. Define it in place
        of `__call__` where it matters how far away, or at which angle, a point was seen."""
        return self(context, scan)

    @property
    def batch_size(self) -> int:
        """How many scans are scored together."""
        return preferred_batch_size(None)

    @property
    def quantity(self) -> Quantity:
        """What its expected value is."""
        meaning = "value of an imagined scan, mean over posterior samples."
        return Quantity(f"acquisition, {type(self).__name__}", "", meaning)

    def answer(self, cloud: PointCloud) -> Answer | None:
        """What D answers to what the acquisition asks; None where it has no answer."""
        return None

    def true_answer(self, scene: Surface, cloud: PointCloud) -> Answer | None:
        """What `answer` should come to in the end; None where that is not known.

        - `scene`: the true surface; `cloud`: points all over it, uniform by area.
        """
        return self.answer(cloud)

    def check(self, cloud: PointCloud) -> None:
        """Raise `ValueError` if what the acquisition is made of gives something impossible on a first D."""
        return


def preferred_batch_size(function: Any) -> int:
    """How many calls of a function to batch: its attribute `batch_size`, where it has one.

    Otherwise a CPU takes them one by one, lest a network's layers leave its cache, and a GPU many at once.
    """
    return getattr(function, "batch_size", 1 if on_cpu() else 128)


class ExpectedUtilityImprovement(Acquisition):
    """max(0, u(D u scan) - u(D)) for any utility u(cloud): the paper's alpha^(u), once averaged over samples.

    - `utility`: a function from a `PointCloud` (rows, masked) to a scalar, made of JAX operations.
    - `num_points`: where given, D is thinned to so many by farthest point sampling, once a step, before scans are
      added to it: for a utility that looks at so many points anyway, and would sample D again for every scan.

    A utility may say more of itself by attributes: `improvement`, the `Quantity` of what is expected; `answer(cloud)`,
    `true_answer(scene, cloud)` and `check(cloud)`, as of an `Acquisition`; `batch_size`. A plain function has its name.
    """

    utility: Callable[[PointCloud], Float[Array, ""]]
    num_points: int | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        check_fields(self)
        require(self.num_points is None or self.num_points >= 1, f"num_points is {self.num_points}; give at least 1")

    def context(self, cloud: PointCloud) -> tuple[PointCloud, Array]:
        """D, thinned, and u(D)."""
        cloud = cloud if self.num_points is None else limit_capacity(cloud, self.num_points)
        return cloud, self.utility(cloud)

    def __call__(self, context: tuple[PointCloud, Float[Array, ""]], scan: PointCloud) -> Float[Array, ""]:
        """max(0, u(D u scan) - u(D))."""
        cloud, utility = context
        return zero_if_empty(scan, jnp.maximum(0.0, self.utility(concatenate(cloud, scan)) - utility))

    @property
    def batch_size(self) -> int:
        """As the utility prefers."""
        return preferred_batch_size(self.utility)

    @property
    def quantity(self) -> Quantity:
        """The utility's `improvement`, or one that is made of its name."""
        meaning = "how much an imagined scan raises the utility of the cloud, mean over posterior samples."
        name = "utility improvement" if self._name == "utility" else f"improvement of {self._name}"
        return getattr(self.utility, "improvement", Quantity(f"expected {name}", "", meaning))

    def answer(self, cloud: PointCloud) -> Answer | None:
        """The utility's own answer, or its value."""
        own = getattr(self.utility, "answer", None)
        return Answer((self._name,), np.array([float(context_of(self, cloud)[1])])) if own is None else own(cloud)

    def true_answer(self, scene: Surface, cloud: PointCloud) -> Answer | None:
        """The utility's own, or its answer on all of the surface."""
        own = getattr(self.utility, "true_answer", None)
        return self.answer(cloud) if own is None else own(scene, cloud)

    def check(self, cloud: PointCloud) -> None:
        """**Raises:** `ValueError` as the utility's own `check` does, or if u(D) is not a finite number."""
        if (own := getattr(self.utility, "check", None)) is not None:
            own(cloud)
        _, value = context_of(self, cloud)
        require(
            jnp.shape(value) == (),
            f"the {self._name} of the cloud has shape {jnp.shape(value)}: a utility is one number",
        )
        require(bool(jnp.isfinite(value)), f"the {self._name} of the first cloud is {value}: it must be finite")

    @property
    def _name(self) -> str:
        """In words; functions without a name of their own are "utility"."""
        name = getattr(self.utility, "__name__", "").strip("_").replace("_", " ")
        return name if name and name != "<lambda>" else "utility"


def as_acquisition(value: Any) -> Acquisition:
    """An acquisition as it is; of a function of a cloud, which is a utility, the expected improvement.

    **Raises:** `ValueError` for anything else.
    """
    if isinstance(value, Acquisition):
        return value
    function = callable(value) and not isinstance(value, type)
    require(function, f"the acquisition is {shown(value)}: give one, such as Coverage(), or a function of a cloud")
    return ExpectedUtilityImprovement(value)


class AcquisitionList(Acquisition):
    """Several acquisitions of the same scans: compared on the same samples, at the cost of one scan.

    Its value is a vector, the members' values in their order (a member whose value is a vector itself takes as many
    places): for `expected_value` and `Problem.scores`, not for a planner.
    """

    members: tuple[Acquisition, ...]

    def __check_init__(self):
        known = isinstance(self.members, tuple) and all(isinstance(member, Acquisition) for member in self.members)
        require(known and len(self.members) > 0, f"the members are {shown(self.members)}; give a tuple of some")

    def context(self, cloud: PointCloud) -> tuple[Any, ...]:
        """That of each."""
        return tuple(member.context(cloud) for member in self.members)

    def score(self, context: tuple[Any, ...], scan: PointCloud, camera: Camera, pose: Pose) -> Float[Array, " values"]:
        """The scores of one scan."""
        found = [member.score(own, scan, camera, pose) for member, own in zip(self.members, context, strict=True)]
        return jnp.concatenate([jnp.atleast_1d(value) for value in found])

    @property
    def batch_size(self) -> int:
        """The least that one prefers."""
        return min(member.batch_size for member in self.members)

    def check(self, cloud: PointCloud) -> None:
        """**Raises:** `ValueError` as one of them does."""
        for member in self.members:
            member.check(cloud)


def context_of(acquisition: Acquisition, cloud: PointCloud) -> Any:
    """What an acquisition makes of D, compiled.

    **Raises:** `ValueError` for a function of the user's that JAX cannot trace.
    """
    with functions_of_users():
        return _context_of(acquisition, cloud)


@eqx.filter_jit
def _context_of(acquisition: Acquisition, cloud: PointCloud) -> Any:
    return acquisition.context(cloud)


def zero_if_empty(scan: PointCloud, value: Float[Array, "*values"]) -> Float[Array, "*values"]:
    """The value, or values, or zero for a scan that sees nothing."""
    return jnp.where(jnp.any(scan.mask), value, 0.0)


def check_differentiable(acquisition: Acquisition, capacity: int, camera: Camera) -> None:
    """Check that JAX can differentiate an acquisition in the points and normals of a scan, without computing anything.

    - `capacity`: rows of the cloud.

    **Raises:** `ValueError` if it cannot, as for anything that calls back to host code.
    """

    def cloud(rows: int) -> PointCloud:
        return PointCloud(jnp.zeros((rows, 3)), jnp.ones((rows, 3)), jnp.ones(rows, bool))

    def value(rows):
        points, normals = rows
        scan, pose = PointCloud(points, normals, cloud(camera.num_rays).mask), Pose(jnp.eye(3), jnp.zeros(3))
        return acquisition.score(acquisition.context(cloud(capacity)), scan, camera, pose)

    rows = cloud(camera.num_rays).points, cloud(camera.num_rays).normals
    # One that fails by itself says so itself.
    jax.eval_shape(value, rows)
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
    cloud: PointCloud,
    surfaces: GridSurface,
    camera: Camera,
    poses: Pose,
    barrier: Float[Array, "poses rays"] | None = None,
) -> Float[Array, "poses *scores"]:
    """The acquisition at each of a batch of poses: mean over the sampled surfaces of the score of what they would show.

    `surfaces` carries the samples along its leading axis; `barrier` is as of `scan`. The members of
    `AcquisitionList` have an axis of their own.

    **Raises:** `ValueError` as the acquisition's `check` does, and for a function of the user's that JAX cannot trace.
    """
    if not is_traced(acquisition, cloud):
        acquisition.check(cloud)
    with functions_of_users():
        context = acquisition.context(cloud)
        return jnp.mean(sample_scores(acquisition, context, surfaces, camera, poses, barrier), axis=0)


def scores(
    acquisition: Acquisition, context: Any, scans: PointCloud, camera: Camera, poses: Pose, samples: int = 1
) -> Float[Array, "poses *scores"]:
    """The score of each of a batch of scans, one from each of a batch of poses, `batch_size` of them at a time; fewer
    where several samples are scored together.
    """
    return batched_map(
        lambda taken: acquisition.score(context, taken[0], camera, taken[1]),
        (scans, poses),
        acquisition.batch_size // samples,
    )


def sample_scores(
    acquisition: Acquisition,
    context: Any,
    surfaces: GridSurface,
    camera: Camera,
    poses: Pose,
    barrier: Float[Array, "poses rays"] | None = None,
) -> Float[Array, "samples poses *scores"]:
    """The score of what each of the sampled surfaces would show from each of a batch of poses.

    All poses are scanned at once, of one sample or of `samples_at_once`, so memory is that of these scans; they are
    scored `batch_size` of them at a time. Samples are shared among devices, or the poses are where samples are too few.

    - `barrier`: see `scan`.
    """
    together = min(samples_at_once(camera, poses), share_of(surfaces.values.shape[0]))
    views = poses, barrier
    return shared_map(_of_sample, surfaces, context, views, acquisition, camera, together, at_once=together)


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
