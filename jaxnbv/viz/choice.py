"""What a search looked at when it chose a view, as plain arrays: candidates, ascents, and a map of the sphere."""

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from jaxnbv.acquisition import Quantity
from jaxnbv.geometry.pose import Pose
from jaxnbv.search import Proposal
from jaxnbv.viz.sphere import unit

# Fewer candidates than this say little about what lies between them.
_FEWEST_OF_A_MAP = 12


class Ascents(eqx.Module):
    """The trajectories of a gradient search, from each of its starts to where it ended.

    - `poses`: with leading axes (starts, steps); `values`: theirs.
    """

    poses: Pose
    values: Float[np.ndarray, "starts steps"]

    @property
    def directions(self) -> Float[np.ndarray, "starts steps 3"]:
        """Unit vectors from the origin to their positions."""
        return unit(np.asarray(self.poses.position, dtype=np.float64))

    @property
    def is_spatial(self) -> bool:
        """Whether cameras left the sphere that they started from, or looked past its centre."""
        positions = np.asarray(self.poses.position, dtype=np.float64)
        past = np.asarray(self.poses.forward, dtype=np.float64) + unit(positions)
        return bool(np.ptp(np.linalg.norm(positions, axis=-1)) > 1e-3 or np.linalg.norm(past, axis=-1).max() > 1e-3)


class Choice(eqx.Module):
    """What the search looked at when it chose a view.

    - `directions`: unit vectors from the origin to the candidates; `values`: theirs, NaN where excluded as visited.
    - `chosen`, `value`: direction and value of the pose that was taken.
    - `ascents`: the trajectories of a gradient search, none of which is among the candidates here; else None.
    - `num_tied`: how many other candidates are tied with the best one; None where it is not known.
    - `errors`: standard errors of the values, and `error` that of the chosen one; None where they are not known.
    - `tied`: which candidates are tied with the best one, itself included; None where not known.
    """

    directions: Float[np.ndarray, "c 3"]
    values: Float[np.ndarray, " c"]
    chosen: Float[np.ndarray, "3"]
    value: float
    ascents: Ascents | None
    num_tied: int | None = None
    errors: Float[np.ndarray, " c"] | None = None
    error: float | None = None
    tied: Bool[np.ndarray, " c"] | None = None

    @property
    def rank(self) -> int:
        """Of the chosen pose among the candidates: 1 for the best."""
        return 1 + int(np.sum(self.values > self.value))

    @property
    def visited(self) -> Bool[np.ndarray, " c"]:
        return np.isnan(self.values)

    @property
    def open_values(self) -> Float[np.ndarray, " o"]:
        """Values of the candidates that were open, best first."""
        return np.sort(self.values[~self.visited])[::-1]

    @property
    def range(self) -> tuple[float, float]:
        """Of the colours of the map and the candidates; not empty."""
        return colour_range(self.values)

    @property
    def rings_tied(self) -> bool:
        """Whether the candidates that are level with the best are marked: they must be known, and not most of all."""
        return self.tied is not None and 0 < (self.num_tied or 0) <= len(self.values) // 3

    @property
    def caption(self) -> str:
        """What the marks on the map are that not every map has."""
        parts = []
        if self.num_tied and not self.rings_tied:
            parts.append(f"The samples cannot tell the best from {self.num_tied} of the others: no rings are drawn.")
        if self.ascents is not None:
            parts.append("Lines: gradient ascents, from a ring where they start to a dot where they end.")
            if self.ascents.is_spatial:
                parts.append("They change position and rotation; drawn is the direction of the position.")
        return " ".join(parts)

    def makes_a_map(self, quantity: Quantity) -> bool:
        """Whether a map between the candidates says something: they must be many, and their values no lots."""
        return quantity.smooth and len(self.open_values) >= _FEWEST_OF_A_MAP


def choice_of(proposal: Proposal) -> Choice:
    """A proposal's candidates as directions, where the chosen one stands among them, and its trajectories."""
    values, ways = open_values(proposal), proposal.trajectories
    return Choice(
        directions=unit(np.asarray(proposal.candidates.position, dtype=np.float64)),
        values=values,
        chosen=unit(np.asarray(proposal.pose.position, dtype=np.float64)),
        value=float(proposal.value),
        ascents=None if ways is None else Ascents(ways.poses, np.asarray(ways.values, np.float64)),
        num_tied=proposal.num_tied,
        errors=None if proposal.standard_errors is None else np.asarray(proposal.standard_errors, np.float64),
        error=proposal.standard_error,
        tied=None if proposal.num_tied is None else np.asarray(proposal.tied_with_best()),
    )


def colour_range(values: Float[np.ndarray, "*n"]) -> tuple[float, float]:
    """The least and the greatest of some values, of which NaN ones are left out; not empty."""
    found = values[~np.isnan(values)]
    if not found.size:
        return 0.0, 1.0
    low, high = float(found.min()), float(found.max())
    return (low, high) if high > low else (low - 0.5, low + 0.5)


def open_values(proposal: Proposal) -> Float[np.ndarray, " c"]:
    """The values of a proposal's candidates, NaN where one was excluded as visited."""
    values = np.asarray(proposal.values, dtype=np.float64)
    return np.where(np.isfinite(values), values, np.nan)
