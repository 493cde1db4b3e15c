"""Searches of studies by the names of methods."""

from collections.abc import Callable

from jaxnbv.search import (
    Candidates,
    ConstrainedPoses,
    DiscreteSearch,
    FarthestView,
    FreePoses,
    GradientSearch,
    HalvingSearch,
    HybridSearch,
    PoseSpace,
    RandomView,
    Search,
    SpherePoses,
    UncertaintyView,
)

# The baselines of all studies that ignore the acquisition.
BASELINES = ("farthest", "uncertainty", "random")
_OVER_CANDIDATES: dict[str, Callable[..., Search]] = {
    "farthest": FarthestView,
    "uncertainty": UncertaintyView,
    "random": RandomView,
    "halving": HalvingSearch,
}
# Free poses drift to views that miss the object, as the paper found; constrained ones keep it in view.
_SPACES: dict[str, Callable[[float], PoseSpace]] = {
    "gradient-2dof": SpherePoses,
    "gradient-6dof": FreePoses,
    "gradient-constrained": lambda radius: ConstrainedPoses(radius - 0.3, radius + 0.3),
}


def search_of(
    method: str,
    candidates: Candidates,
    num_candidates: int,
    radius: float,
    num_starts: int,
    iterations: int,
    learning_rate: float = 0.03,
) -> Search:
    """The search that a method is named after, or `DiscreteSearch` over all candidates for any other name.

    A search by gradient, around `radius` (scene units), scores half of `num_candidates` and climbs from the best
    `num_starts`.
    """
    if method in _SPACES:
        settings = num_starts, iterations, learning_rate, max(num_candidates // 2, num_starts)
        return GradientSearch(None, _SPACES[method](radius), *settings)
    if method == "hybrid":
        return HybridSearch(space=SpherePoses(radius), candidates=candidates)
    return _OVER_CANDIDATES.get(method, DiscreteSearch)(candidates)
