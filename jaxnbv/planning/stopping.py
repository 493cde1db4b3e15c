"""When an episode is long enough: rules, to be combined by `|`, of which the first that holds ends it."""

import time
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxnbv.acquisition import Score, expected_score
from jaxnbv.checks import InputError, check_fields, require, shown
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose
from jaxnbv.planning.planner import Planner
from jaxnbv.planning.state import State
from jaxnbv.planning.travel import CostFunction, arc_length, total_cost
from jaxnbv.scanning import GridSurface
from jaxnbv.search import Proposal, SphereCandidates
from jaxnbv.search.base import CandidateSearch
from jaxnbv.tasks.classification import predict
from jaxnbv.tasks.coverage import SeenBefore
from jaxnbv.tasks.segmentation import PartAnswer


class SoFar(NamedTuple):
    """An episode between two views.

    - `poses`: of the views so far; `state`: what the planner knows after them.
    - `seconds`: since this process began to take views.
    - `key`: that of the next step's samples.
    """

    planner: Planner
    state: State
    poses: tuple[Pose, ...]
    seconds: float
    key: PRNGKeyArray


class Stop(eqx.Module):
    """A rule that says when no more views are needed: one after a view, another before the next is taken."""

    def check(self, planner: Planner) -> None:
        """Raise `ValueError` if the planner cannot be asked what the rule is about."""
        return

    def after(self, so_far: SoFar) -> str | None:
        """Why the views so far are enough, in words; None to go on."""
        return None

    def before(self, so_far: SoFar, proposal: Proposal) -> str | None:
        """Why the view that is proposed next is not to be taken; None to go on."""
        return None

    def __or__(self, other: "Stop") -> "Stop":
        return AnyOf((self, other))


class AnyOf(Stop):
    """The first of some rules that holds."""

    rules: tuple[Stop, ...]

    def check(self, planner: Planner) -> None:
        for rule in self.rules:
            rule.check(planner)

    def after(self, so_far: SoFar) -> str | None:
        return next(filter(None, (rule.after(so_far) for rule in self.rules)), None)

    def before(self, so_far: SoFar, proposal: Proposal) -> str | None:
        return next(filter(None, (rule.before(so_far, proposal) for rule in self.rules)), None)


class Sure(Stop):
    """The class is known: with this probability given D and, as a single answer may be sure by chance and change with
    the next view, given random halves of D too.

    - `probability`: within (0, 1).
    - `resamplings`: how many halves are drawn.

    **Raises:** `ValueError` for another probability or a negative number; of a planner, if its score has no classifier.
    """

    probability: float = eqx.field(static=True, default=0.95)
    resamplings: int = eqx.field(static=True, default=8)

    def __check_init__(self):
        check_fields(self)
        require(0 < self.probability < 1, f"the probability is {self.probability}; it must lie within (0, 1)")
        require(self.resamplings >= 0, f"the number of resamplings is {self.resamplings}; it must not be negative")

    def check(self, planner: Planner) -> None:
        score = planner.acquisition
        known = hasattr(score, "classifier") or hasattr(getattr(score, "utility", None), "classifier")
        require(
            known,
            f"Sure is about a class, but {type(score).__name__} has no classifier: use CrossEntropy, MixedEntropy or "
            "the utility NegativeEntropy, or another rule",
        )

    def after(self, so_far: SoFar) -> str | None:
        score, cloud = so_far.planner.acquisition, so_far.state.cloud
        p = _probabilities(score, cloud)
        best = int(np.argmax(p))
        least = float(p[best])
        for index in range(self.resamplings):
            if least < self.probability:
                return None
            least = min(
                least, float(_probabilities(score, half_of(cloud, jax.random.fold_in(so_far.key, index)))[best])
            )
        if least < self.probability:
            return None
        answer = score.answer(cloud)
        name = f"class {best}" if answer is None else answer.names[best]
        halves = f", {least:.2f} at least given a half of the points" if self.resamplings else ""
        return f"sure of {name}: {float(p[best]):.2f}{halves}"


class Found(Stop):
    """All parts have been found.

    - `points`: predicted points of a part by which it is found.
    - `parts`: names of those to be found; by default all that the segmenter is asked for, of which the object may lack
      one.

    **Raises:** `ValueError` for a number of points below one; of a planner, if its score has no segmenter, or that does
    not know a part.
    """

    points: int = eqx.field(static=True, default=60)
    parts: tuple[str, ...] | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        check_fields(self)
        require(self.points >= 1, f"a part is found by {self.points} points; give at least 1")
        names = isinstance(self.parts, tuple) and all(isinstance(name, str) for name in self.parts)
        require(self.parts is None or names, f"the parts are {shown(self.parts)}; give a tuple of their names")

    def check(self, planner: Planner) -> None:
        segmenter = getattr(getattr(planner.acquisition, "utility", None), "segmenter", None)
        require(
            segmenter is not None,
            f"Found is about parts, but {type(planner.acquisition).__name__} has no segmenter: use the utility "
            "SoftPartCount, or another rule",
        )
        known = getattr(segmenter, "part_names", None)
        names = () if known is None else tuple(known.values())
        require(
            bool(self.parts or names),
            "the segmenter does not name the parts that it is asked for: give Found(parts=...), 'part 0' and so on",
        )
        unknown = [name for name in self.parts or () if names and name not in names]
        require(not unknown, f"the segmenter knows no part {unknown[:1]}: give some of {', '.join(names)}")

    def after(self, so_far: SoFar) -> str | None:
        answer = so_far.planner.acquisition.answer(so_far.state.cloud)
        if not isinstance(answer, PartAnswer):
            raise InputError("the score's answer tells no parts")
        found = dict(zip(answer.names, answer.values.tolist(), strict=True))
        wanted = self.parts or tuple(answer.names[index] for index in answer.asked)
        if any(found.get(name, 0) < self.points for name in wanted):
            return None
        return f"all of {len(wanted)} parts are found, by {self.points} points or more"


class Covered(Stop):
    """So much has been seen of what can be seen, in expectation over the posterior.

    Of all points that the sensor would see of the sampled surfaces from the candidates, the share that lies near D. Of
    three objects it was right to 0.02 on one, and up to 0.28 too low on two: it ends late rather than early.

    - `share`: within (0, 1].
    - `radius`: within which of D a point counts as seen, in scene units.

    **Raises:** `ValueError` for another share, or a radius that is not positive.
    """

    share: float = eqx.field(static=True, default=0.98)
    radius: float = eqx.field(static=True, default=0.05)

    def __check_init__(self):
        check_fields(self)
        require(0 < self.share <= 1, f"the share is {self.share}; it must lie within (0, 1]")
        SeenBefore(self.radius)

    def after(self, so_far: SoFar) -> str | None:
        covered = expected_coverage(so_far.planner, so_far.state, so_far.key, self.radius)
        return f"{100 * covered:.1f} % of what can be seen is expected to be covered" if covered >= self.share else None


class WorthLess(Stop):
    """The best view that is proposed is worth less than this, in the units of what the search maximises."""

    value: float = eqx.field(static=True)

    def __check_init__(self):
        check_fields(self)

    def before(self, so_far: SoFar, proposal: Proposal) -> str | None:
        value = float(proposal.value)
        return f"the best view is worth {value:.3g}, less than {self.value:.3g}" if value < self.value else None


class Budget(Stop):
    """Time is up, or the next view would cost more than is left.

    - `seconds`: of this process, since its first view; the view that is under way is finished.
    - `cost`: of the whole way through all views, by the function `of`.

    **Raises:** `ValueError` for neither, or one that is not positive.
    """

    seconds: float | None = eqx.field(static=True, default=None)
    cost: float | None = eqx.field(static=True, default=None)
    of: CostFunction = eqx.field(static=True, default=arc_length)

    def __check_init__(self):
        check_fields(self)
        given = [limit for limit in (self.seconds, self.cost) if limit is not None]
        require(len(given) > 0, "the budget is of nothing: give seconds or cost")
        require(all(limit > 0 for limit in given), f"the budget is {given}; it must be positive")

    def after(self, so_far: SoFar) -> str | None:
        if self.seconds is None or so_far.seconds < self.seconds:
            return None
        return f"{so_far.seconds:.0f} of {self.seconds:g} seconds are spent"

    def before(self, so_far: SoFar, proposal: Proposal) -> str | None:
        if self.cost is None:
            return None
        left = self.cost - total_cost(so_far.poses, self.of)
        asked = float(self.of(so_far.poses[-1], proposal.pose))
        return (
            f"the next view would cost {asked:.3g}, but {left:.3g} of {self.cost:g} are left" if asked > left else None
        )


class Watch:
    """A rule that is asked as an episode goes on.

    **Raises:** `ValueError` if the planner cannot be asked what the rule is about.
    """

    def __init__(self, rule: Stop, planner: Planner):
        rule.check(planner)
        self.rule, self.planner, self.began = rule, planner, time.monotonic()
        self.reason: str | None = None

    def after(self, state: State, poses: Sequence[Pose], key: PRNGKeyArray) -> str | None:
        """Why the views so far are enough; None to go on."""
        self.reason = self.rule.after(self._so_far(state, poses, key))
        return self.reason

    def before(self, state: State, poses: Sequence[Pose], key: PRNGKeyArray, proposal: Proposal) -> str | None:
        """Why what is proposed is not to be taken; None to go on."""
        self.reason = self.rule.before(self._so_far(state, poses, key), proposal)
        return self.reason

    def _so_far(self, state: State, poses: Sequence[Pose], key: PRNGKeyArray) -> SoFar:
        return SoFar(self.planner, state, tuple(poses), time.monotonic() - self.began, key)


def expected_coverage(planner: Planner, state: State, key: PRNGKeyArray, radius: float = 0.05) -> float:
    """Share of what the planner's camera would see of the posterior's surfaces, from all candidates, that lies near D.

    - `radius`: how near, in scene units.
    """
    search = planner.search
    candidates = search.candidates if isinstance(search, CandidateSearch) else SphereCandidates()
    surfaces, poses = planner.sample_surfaces(state, key), candidates.poses()
    near, seen = np.asarray(_seen_before(SeenBefore(radius), planner, state.cloud, surfaces, poses))
    return float(near / seen) if seen else 1.0


@eqx.filter_jit
def _seen_before(
    score: SeenBefore, planner: Planner, cloud: PointCloud, surfaces: GridSurface, poses: Pose
) -> Float[Array, "2"]:
    found = expected_score(score, cloud, surfaces, planner.camera, poses, planner.barrier(poses))
    return jnp.sum(found, axis=0)


@jax.jit
def half_of(cloud: PointCloud, key: PRNGKeyArray) -> PointCloud:
    """Each of a cloud's points with probability one half."""
    kept = cloud.mask & jax.random.bernoulli(key, 0.5, cloud.mask.shape)
    points, normals = (jnp.where(kept[:, None], rows, 0.0) for rows in (cloud.points, cloud.normals))
    return PointCloud(points, normals, kept)


def _probabilities(score: Score, cloud: PointCloud) -> Float[np.ndarray, " classes"]:
    log_p = predict(score, cloud)
    if log_p is None:
        raise InputError(f"{type(score).__name__} tells no class")
    return np.exp(np.asarray(log_p, np.float64))
