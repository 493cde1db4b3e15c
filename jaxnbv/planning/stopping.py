"""When an episode is long enough, whatever it is for: its value, time and cost; and the watch over any rule."""

import time
from collections.abc import Sequence

import equinox as eqx
from jaxtyping import PRNGKeyArray

from jaxnbv.acquisition import Acquisition
from jaxnbv.checks import check_fields, require
from jaxnbv.geometry.pose import Pose
from jaxnbv.observations import Observations
from jaxnbv.planning.planner import Planner
from jaxnbv.planning.travel import CostFunction, arc_length, total_cost
from jaxnbv.search import CandidateSearch, Proposal, SphereCandidates
from jaxnbv.tasks.stopping import StopContext, StopRule


class ValueBelow(StopRule):
    """Stop once the best view's value is less than this, in the units of what the search maximises."""

    value: float = eqx.field(static=True)

    def __check_init__(self):
        check_fields(self)

    def before(self, context: StopContext, pose: Pose, value: float) -> str | None:
        return f"the best view has a value of {value:.3g}, less than {self.value:.3g}" if value < self.value else None


class Budget(StopRule):
    """Stop when time is up, or when the next view would cost more than is left.

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
        left = self.cost - total_cost(context.poses, self.of)
        asked = total_cost((context.poses[-1], pose), self.of)
        return (
            f"the next view would cost {asked:.3g}, but {left:.3g} of {self.cost:g} are left" if asked > left else None
        )


class Watch:
    """A rule that is asked as an episode goes on; `reason` is why it ends.

    **Raises:** `ValueError` if the rule cannot hold of what views are for.
    """

    def __init__(self, rule: StopRule, acquisition: Acquisition):
        rule.check(acquisition)
        self.rule, self.began = rule, time.monotonic()
        self.reason: str | None = None

    def ends(
        self,
        planner: Planner,
        observations: Observations,
        poses: Sequence[Pose],
        key: PRNGKeyArray,
        proposal: Proposal | None = None,
    ) -> bool:
        """Whether the views so far are enough or, once the next is proposed, it is not to be taken."""
        known = context(planner, observations, poses, key, time.monotonic() - self.began)
        if proposal is None:
            self.reason = self.rule.after(known)
        else:
            self.reason = self.rule.before(known, proposal.pose, float(proposal.value))
        return self.reason is not None


def context(
    planner: Planner, observations: Observations, poses: Sequence[Pose], key: PRNGKeyArray, seconds: float = 0.0
) -> StopContext:
    """What a rule is asked about."""
    search = planner.search
    candidates = search.candidates if isinstance(search, CandidateSearch) else SphereCandidates()
    known = planner.acquisition, planner.camera, planner.sampler, candidates.poses()
    return StopContext(*known, observations, tuple(poses), seconds, key)
