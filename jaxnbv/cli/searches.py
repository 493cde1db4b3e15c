"""What the searches of the command line stand for, about the cameras of a sensor's setting."""

from typing import Any

from jaxnbv.search import (
    ConstrainedPoses,
    DiscreteSearch,
    FarthestView,
    GradientSearch,
    HalvingSearch,
    HybridSearch,
    RandomView,
    Search,
    SphereCandidates,
    SpherePoses,
    TieBreakSearch,
    UncertaintyView,
)
from jaxnbv.tasks import Coverage

_OVER_CANDIDATES: dict[str, type[Search]] = {
    "discrete": DiscreteSearch,
    "halving": HalvingSearch,
    "farthest": FarthestView,
    "random": RandomView,
    "uncertainty": UncertaintyView,
}


def search_of(name: str, radius: float, count: int | None) -> Search:
    """The search of a name; where `count` is None with its own number of candidates."""
    candidates = SphereCandidates(radius=radius) if count is None else SphereCandidates(count, radius)
    if name in _OVER_CANDIDATES:
        return _OVER_CANDIDATES[name](candidates)
    if name == "tie-break":
        return TieBreakSearch(candidates, second=Coverage())
    number: dict[str, Any] = {} if count is None else {"num_candidates": count}
    if name == "hybrid":
        return HybridSearch(space=SpherePoses(radius), **number)
    shell = ConstrainedPoses(nearest=radius - 0.3, farthest=radius + 0.3)
    return GradientSearch(space=SpherePoses(radius) if name == "gradient-2dof" else shell, **number)
