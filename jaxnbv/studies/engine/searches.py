"""Searches of the methods that have the same name in all studies."""

from collections.abc import Callable

from jaxnbv import search
from jaxnbv.search import Candidates, PoseSpace, Search

# Baselines of all studies.
BASELINES = ("farthest", "uncertainty", "random")
_OVER_CANDIDATES: dict[str, Callable[..., Search]] = {
    "farthest": search.FarthestView,
    "uncertainty": search.UncertaintyView,
    "random": search.RandomView,
    "halving": search.HalvingSearch,
}
# The paper found that gradient search over free poses drifts to views that miss the object. Constrained poses keep the
# object in view.
_SPACES: dict[str, Callable[[float], PoseSpace]] = {
    "gradient-2dof": search.SpherePoses,
    "gradient-6dof": search.FreePoses,
    "gradient-constrained": lambda radius: search.ConstrainedPoses(radius - 0.3, radius + 0.3),
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
    """Return the search named by a method, such as `RandomView` for "random".

    An unknown name gives `DiscreteSearch` over all candidates. A gradient search scores half of `num_candidates` poses,
    and then follows the gradient from the best `num_starts` of them. "hybrid" scores all candidates, and ignores
    `num_starts`, `iterations` and `learning_rate`. `radius` is the cameras' distance from the origin, in scene units.
    """
    if method in _SPACES:
        settings = num_starts, iterations, learning_rate, max(num_candidates // 2, num_starts)
        return search.GradientSearch(None, _SPACES[method](radius), *settings)
    if method == "hybrid":
        return search.HybridSearch(space=search.SpherePoses(radius), candidates=candidates)
    return _OVER_CANDIDATES.get(method, search.DiscreteSearch)(candidates)
