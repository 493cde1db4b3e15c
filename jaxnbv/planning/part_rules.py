"""Stop rules about an object's segmented parts, and about which known part the object is and where."""

import equinox as eqx

from jaxnbv.acquisition import ExpectedUtilityImprovement
from jaxnbv.checks import InputError, check_fields, require, short_text
from jaxnbv.planning.planner import Planner
from jaxnbv.planning.stopping import StopContext, StopRule
from jaxnbv.surfaces.part_hypotheses import hypotheses_of
from jaxnbv.surfaces.part_pose import surface_error
from jaxnbv.tasks.segmentation import PartAnswer, SoftPartCount


class PartsFound(StopRule):
    """Stop once the segmenter predicts enough points for every part.

    - `points`: smallest number of predicted points for each part.
    - `parts`: names of the parts to find, by default all of the segmenter's parts. Give names if some may be absent.

    **Raises:** `ValueError` for a number of points below one, an acquisition without a segmenter, or a name that is not
    a part of the segmenter.
    """

    points: int = eqx.field(static=True, default=60)
    parts: tuple[str, ...] | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        check_fields(self)
        require(self.points >= 1, f"a part is found by {self.points} points; give at least 1")
        are_names = isinstance(self.parts, tuple) and all(isinstance(name, str) for name in self.parts)
        require(self.parts is None or are_names, f"the parts are {short_text(self.parts)}; give a tuple of their names")

    def check(self, planner: Planner) -> None:
        acquisition = planner.acquisition
        utility = acquisition.utility if isinstance(acquisition, ExpectedUtilityImprovement) else None
        if not isinstance(utility, SoftPartCount):
            raise InputError(
                f"PartsFound is about parts, but {type(acquisition).__name__} has no segmenter: use the utility "
                "SoftPartCount, or another rule"
            )
        names = tuple((utility.segmenter.part_names or {}).values())
        require(
            bool(self.parts or names),
            "the segmenter has no names for its parts: give the parts to find as PartsFound(parts=('part 0', ...))",
        )
        unknown_names = [name for name in self.parts or () if names and name not in names]
        require(not unknown_names, f"the segmenter has no part {unknown_names[:1]}: give some of {', '.join(names)}")

    def after(self, context: StopContext) -> str | None:
        answer = context.planner.acquisition.answer(context.observations.cloud)
        if not isinstance(answer, PartAnswer):
            raise InputError("the acquisition's answer has no parts: PartsFound needs the answer of SoftPartCount")
        counts = dict(zip(answer.names, answer.values.tolist(), strict=True))
        names = self.parts or tuple(answer.names[index] for index in answer.parts)
        if any(counts.get(name, 0) < self.points for name in names):
            return None
        return f"all {len(names)} parts are found, each by {self.points} points or more"


class _KnownPartRule(StopRule):
    """Base class of rules that read the hypotheses about known parts."""

    def check(self, planner: Planner) -> None:
        require(
            planner.sampler.model.carries_hypotheses,
            f"{type(self).__name__} is about known parts, but the planner knows none: use Planner.for_parts(bank), or "
            "another rule",
        )


class Identified(_KnownPartRule):
    """Stop once one of the known parts, or "none of these", has at least a given probability.

    - `probability`: smallest probability at which to stop, within (0, 1).

    **Raises:** `ValueError` for a probability outside (0, 1), or a planner without known parts.
    """

    probability: float = eqx.field(static=True, default=0.95)

    def __check_init__(self):
        check_fields(self)
        require(0 < self.probability < 1, f"the probability is {self.probability}; it must lie within (0, 1)")

    def after(self, context: StopContext) -> str | None:
        name, probability = next(iter(hypotheses_of(context.observations).names().items()))
        return f"it is {name} ({100 * probability:.0f} %)" if probability >= self.probability else None


class Placed(_KnownPartRule):
    """Stop once the expected error of the most probable part's surface is at most a given length.

    The error is `surface_error`, a root mean square over the surface and over the hypotheses.

    - `length`: largest error at which to stop, in world units (in a simulation, scene units).

    **Raises:** `ValueError` for a length that is not positive, or a planner without known parts.
    """

    length: float = eqx.field(static=True)

    def __check_init__(self):
        check_fields(self)
        require(self.length > 0, f"the length is {self.length}; it must be positive")

    def after(self, context: StopContext) -> str | None:
        error = surface_error(hypotheses_of(context.observations), context.observations)
        error = float(context.frame.length_to_world(error))
        return f"its surface is known to {error:.2g}" if error <= self.length else None
