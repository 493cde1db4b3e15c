"""What a rule of stopping is. Each stands with what it knows: a class, parts, coverage here; time and cost in
`jaxnbv.planning.stopping`. Rules are combined by `|`."""

from typing import NamedTuple

import equinox as eqx
from jaxtyping import PRNGKeyArray

from jaxnbv.acquisition import Acquisition
from jaxnbv.checks import check_type
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.pose import Pose
from jaxnbv.observations import Observations
from jaxnbv.sampler import SurfaceSampler


class StopContext(NamedTuple):
    """An episode between two views.

    - `acquisition`, `camera`, `sampler`: the planner's.
    - `candidates`: poses that its search chooses among, or others all about the object.
    - `observations`: what is known after the views so far; `poses`: theirs.
    - `seconds`: since this process began to take views.
    - `key`: that of the next step's samples.
    """

    acquisition: Acquisition
    camera: Camera
    sampler: SurfaceSampler
    candidates: Pose
    observations: Observations
    poses: tuple[Pose, ...]
    seconds: float
    key: PRNGKeyArray


class StopRule(eqx.Module):
    """A rule that says when no more views are needed: after a view, or when the next is planned but not yet taken.

    `needs_proposal`: whether it is asked about the planned view too.
    """

    @property
    def needs_proposal(self) -> bool:
        return type(self).before is not StopRule.before

    def check(self, acquisition: Acquisition) -> None:
        """Raise `ValueError` if the rule cannot hold of what views are for."""
        return

    def after(self, context: StopContext) -> str | None:
        """Why the views so far are enough, in words; None to go on."""
        return None

    def before(self, context: StopContext, pose: Pose, value: float) -> str | None:
        """Why the view that is proposed next, of this value, is not to be taken; None to go on."""
        return None

    def __or__(self, other: "StopRule") -> "StopRule":
        check_type(other, StopRule, "a rule of stopping")
        return AnyOf((self, other))


class AnyOf(StopRule):
    """The first of some rules that holds."""

    rules: tuple[StopRule, ...]

    @property
    def needs_proposal(self) -> bool:
        return any(rule.needs_proposal for rule in self.rules)

    def check(self, acquisition: Acquisition) -> None:
        for rule in self.rules:
            rule.check(acquisition)

    def after(self, context: StopContext) -> str | None:
        return next(filter(None, (rule.after(context) for rule in self.rules)), None)

    def before(self, context: StopContext, pose: Pose, value: float) -> str | None:
        return next(filter(None, (rule.before(context, pose, value) for rule in self.rules)), None)
