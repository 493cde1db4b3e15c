"""Stop rules: conditions that end an episode, checked after each view or before a proposed view.

The operator `|` combines rules, so that the episode ends as soon as one of them holds. In a simulation, world units are
scene units. Rules about known or segmented parts are in `planning/part_rules.py`.
"""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from jaxnbv.acquisition import Acquisition, context_of
from jaxnbv.checks import InputError, check_fields, check_type, require, short_text
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.pose import Pose
from jaxnbv.observations import Observations
from jaxnbv.planning.planner import Planner
from jaxnbv.planning.travel import CostFunction, WorldCost, arc_length, total_cost
from jaxnbv.scanning import GridSurface, barrier_of
from jaxnbv.tasks.classification import ClassAcquisition
from jaxnbv.tasks.coverage import NewSurface, new_surface_of, seen_share


@dataclasses.dataclass(frozen=True)
class StopContext:
    """The state of an episode between two views, for stop rules.

    - `planner`, `observations`: planner and observations for the next view, in scene coordinates.
    - `poses`: poses of the views so far, in scene coordinates.
    - `seconds`: time since the first view that this process added.
    - `key`: random key of the posterior samples for the next view.
    - `surfaces`: function that returns the posterior samples. They are drawn once, and the search uses them too.
    - `frame`: frame of the user's world. Values and costs are in units of this world.
    """

    planner: Planner
    observations: Observations
    poses: tuple[Pose, ...]
    seconds: float
    key: PRNGKeyArray
    surfaces: Callable[[], GridSurface]
    frame: Frame

    def cost(self, poses: tuple[Pose, ...], cost: CostFunction) -> float:
        """Return the cost of the path through scene poses. `cost` is called with poses in world coordinates."""
        return total_cost(poses, WorldCost(cost, self.frame))


class StopRule(eqx.Module):
    """Base class of rules that end an episode, either after a view or before a proposed view is taken."""

    @property
    def needs_proposal(self) -> bool:
        """Whether the rule checks the proposed view, so that `before` must be called."""
        return type(self).before is not StopRule.before

    def check(self, planner: Planner) -> None:
        """Raise `ValueError` if the rule does not apply to this planner. Called before the first view."""
        return

    def after(self, context: StopContext) -> str | None:
        """Return the reason to stop after the views so far; None to continue."""
        return None

    def before(self, context: StopContext, pose: Pose, value: float) -> str | None:
        """Return the reason to stop before the proposed view; None to continue.

        - `pose`, `value`: proposed pose in scene coordinates, and its value in world units.
        """
        return None

    def __or__(self, other: "StopRule") -> "StopRule":
        check_type(other, StopRule, "a stop rule")
        return AnyOf((self, other))


class AnyOf(StopRule):
    """Stop once any of these rules holds. The reason comes from the first rule that holds, in order."""

    rules: tuple[StopRule, ...]

    @property
    def needs_proposal(self) -> bool:
        return any(rule.needs_proposal for rule in self.rules)

    def check(self, planner: Planner) -> None:
        for rule in self.rules:
            rule.check(planner)

    def after(self, context: StopContext) -> str | None:
        return next(filter(None, (checked_reason(rule, rule.after(context)) for rule in self.rules)), None)

    def before(self, context: StopContext, pose: Pose, value: float) -> str | None:
        reasons = (checked_reason(rule, rule.before(context, pose, value)) for rule in self.rules)
        return next(filter(None, reasons), None)


def checked_reason(rule: StopRule, reason: str | None) -> str | None:
    """Check the `reason` that a rule returned, and return the reason.

    **Raises:** `ValueError` unless the reason is a non-empty string or None.
    """
    require(
        reason is None or (isinstance(reason, str) and bool(reason)),
        f"the stop rule {type(rule).__name__} returned {short_text(reason)}: it must return the reason in words, or "
        "None to go on",
    )
    return reason


class Sure(StopRule):
    """Stop once the most probable class has at least a given probability.

    The class must also have this probability given each of several random halves of the cloud D, because a classifier
    may be sure of a single cloud by chance.

    - `probability`: smallest probability at which to stop, within (0, 1).
    - `num_resamplings`: number of random halves.

    **Raises:** `ValueError` for a value out of range, or an acquisition without a classifier.
    """

    probability: float = eqx.field(static=True, default=0.95)
    num_resamplings: int = eqx.field(static=True, default=8)

    def __check_init__(self):
        check_fields(self)
        require(0 < self.probability < 1, f"the probability is {self.probability}; it must lie within (0, 1)")
        require(
            self.num_resamplings >= 0, f"the number of resamplings is {self.num_resamplings}; it must not be negative"
        )

    def check(self, planner: Planner) -> None:
        _class_acquisition(planner.acquisition)

    def after(self, context: StopContext) -> str | None:
        return self.reason(context.planner.acquisition, context.observations.cloud, context.key)

    def reason(self, acquisition: Acquisition, cloud: PointCloud, key: PRNGKeyArray) -> str | None:
        """Return the reason to stop given a cloud; None to continue. `key` draws the halves."""
        acquisition = _class_acquisition(acquisition)
        answer = acquisition.answer(cloud)
        best = int(np.argmax(answer.values))
        lowest = float(answer.values[best])
        for index in range(self.num_resamplings):
            if lowest < self.probability:
                return None
            half = acquisition.answer(half_of(cloud, jax.random.fold_in(key, index)))
            lowest = min(lowest, float(half.values[best]))
        if lowest < self.probability:
            return None
        halves = f", and at least {100 * lowest:.0f} % given half of the points" if self.num_resamplings else ""
        return f"sure of {answer.names[best]} ({100 * float(answer.values[best]):.0f} %{halves})"


def _class_acquisition(acquisition: Acquisition) -> ClassAcquisition:
    if not isinstance(acquisition, ClassAcquisition):
        raise InputError(
            f"Sure is about a class, but {type(acquisition).__name__} has no classifier: use CrossEntropy or "
            "MixedEntropy, or another rule"
        )
    return acquisition


@jax.jit
def half_of(cloud: PointCloud, key: PRNGKeyArray) -> PointCloud:
    """Return a random subset of a cloud, which contains each point with probability one half."""
    return cloud.only(jax.random.bernoulli(key, 0.5, cloud.mask.shape))


class Covered(StopRule):
    """Stop once `expected_coverage`, the fraction of the visible area seen so far, is large enough.

    - `share`: fraction of the area at which to stop, within (0, 1].
    - `size`: surface within this distance of measured surface counts as seen, in world units (`NewSurface.size`). The
      default is the acquisition's size if the acquisition is a `NewSurface`, otherwise that of `NewSurface()`.

    **Raises:** `ValueError` for a `share` outside (0, 1], or a size that is not positive.
    """

    share: float = eqx.field(static=True, default=0.98)
    size: float | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        check_fields(self)
        require(0 < self.share <= 1, f"the share is {self.share}; it must lie within (0, 1]")
        if self.size is not None:
            NewSurface(self.size)

    def after(self, context: StopContext) -> str | None:
        new_surface = new_surface_of(context.planner.acquisition)
        if self.size is not None:
            new_surface = NewSurface(self.size * context.frame.scale)
        share = expected_coverage(context, new_surface)
        return f"{100 * share:.1f} % of what can be seen is expected to be covered" if share >= self.share else None


def expected_coverage(context: StopContext, new_surface: NewSurface) -> float:
    """Return the expected fraction of the visible area that the views so far have seen.

    The visible area is the area of the posterior samples that is visible from any candidate, see `seen_share`. Sampled
    surface that an earlier view should have measured but did not is left out.

    - `new_surface`: acquisition that determines which surface is new.
    """
    planner, observations, surfaces = context.planner, context.observations, context.surfaces()
    if observations.looks is not None and not planner.acquisition.measurable_only:
        surfaces = observations.looks.without_unmeasured(surfaces, observations.poses)
    poses = planner.search.poses_around()
    barrier = barrier_of(planner.obstacles, planner.camera, poses)
    newness = context_of(new_surface, observations)
    return float(seen_share(newness, surfaces, planner.camera, poses, observations.poses, barrier))


class ValueBelow(StopRule):
    """Stop once the proposed view's value is below a limit.

    - `value`: limit in the unit of the search's values, with lengths in world units (in a simulation, scene units).
    """

    value: float = eqx.field(static=True)

    def __check_init__(self):
        check_fields(self)

    def before(self, context: StopContext, pose: Pose, value: float) -> str | None:
        if value >= self.value:
            return None
        unit = context.planner.quantity.unit_in(context.frame)
        return f"the best view has a value of {value:.3g} {unit}".rstrip() + f", less than {self.value:.3g}"


class Budget(StopRule):
    """Stop when the time is over, or when the next view would exceed the cost.

    - `seconds`: time limit, counted from the first view that this process adds. The time is checked between views.
    - `cost`: limit of the cost of the whole path through all views.
    - `of`: cost of a move between two poses in world coordinates (in a simulation, scene coordinates).

    **Raises:** `ValueError` if both limits are None, or if a limit is not positive.
    """

    seconds: float | None = eqx.field(static=True, default=None)
    cost: float | None = eqx.field(static=True, default=None)
    of: CostFunction = eqx.field(static=True, default=arc_length)

    def __check_init__(self):
        check_fields(self)
        limits = [limit for limit in (self.seconds, self.cost) if limit is not None]
        require(len(limits) > 0, "the budget has no limit: give seconds or cost")
        require(all(limit > 0 for limit in limits), f"the budget is {limits}; it must be positive")

    @property
    def needs_proposal(self) -> bool:
        return self.cost is not None

    def after(self, context: StopContext) -> str | None:
        if self.seconds is None or context.seconds < self.seconds:
            return None
        return f"{context.seconds:.0f} of {self.seconds:g} seconds are spent"

    def before(self, context: StopContext, pose: Pose, value: float) -> str | None:
        if self.cost is None:
            return None
        remainder = self.cost - context.cost(context.poses, self.of)
        next_cost = context.cost((context.poses[-1], pose), self.of)
        if next_cost <= remainder:
            return None
        return f"the next view would cost {next_cost:.3g}, but {remainder:.3g} of {self.cost:g} are left"
