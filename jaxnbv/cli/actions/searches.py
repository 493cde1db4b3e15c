"""What the searches of the command line stand for, about the cameras of a sensor's setting.

Where `count` is None, a search keeps its own number of candidates.
"""

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


def discrete(radius: float, count: int | None) -> Search:
    """Over all candidates."""
    return DiscreteSearch(_candidates(radius, count))


def halving(radius: float, count: int | None) -> Search:
    """Over candidates, by successive halving."""
    return HalvingSearch(_candidates(radius, count))


def tie_break(radius: float, count: int | None) -> Search:
    """Over all candidates, by coverage where the task does not tell."""
    return TieBreakSearch(_candidates(radius, count), second=Coverage())


def farthest(radius: float, count: int | None) -> Search:
    """The paper's baseline."""
    return FarthestView(_candidates(radius, count))


def random(radius: float, count: int | None) -> Search:
    """The paper's baseline."""
    return RandomView(_candidates(radius, count))


def uncertainty(radius: float, count: int | None) -> Search:
    """The paper's baseline."""
    return UncertaintyView(_candidates(radius, count))


def gradient_2dof(radius: float, count: int | None) -> Search:
    """Over the sphere."""
    return GradientSearch(space=SpherePoses(radius), **_number(count))


def gradient_6dof(radius: float, count: int | None) -> Search:
    """Over positions and rotations in a shell."""
    return GradientSearch(space=ConstrainedPoses(nearest=radius - 0.3, farthest=radius + 0.3), **_number(count))


def hybrid(radius: float, count: int | None) -> Search:
    """Over the sphere, from the best of many candidates."""
    return HybridSearch(space=SpherePoses(radius), **_number(count))


def _candidates(radius: float, count: int | None) -> SphereCandidates:
    return SphereCandidates(radius=radius) if count is None else SphereCandidates(count, radius)


def _number(count: int | None) -> dict[str, Any]:
    return {} if count is None else {"num_candidates": count}
