"""What happened at every view, in words, and what the values of a search are called."""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxnbv.acquisition import ExpectedUtilityImprovement, Score
from jaxnbv.camera import Pose
from jaxnbv.search import FarthestView, RandomView, Search, UncertaintyView
from jaxnbv.tasks import ColdestPoint, Coverage, CrossEntropy, MixedEntropy, NegativeEntropy, SoftPartCount


class Quantity(eqx.Module):
    """What a search maximises.

    - `name`, `unit`: in words; the unit is empty where there is none.
    - `meaning`: the rest of a caption that begins with "Value:".
    - `smooth`: whether values between two candidates mean anything.
    """

    name: str
    unit: str
    meaning: str
    smooth: bool = True

    @property
    def label(self) -> str:
        return f"{self.name} ({self.unit})" if self.unit else self.name

    def show(self, value: float) -> str:
        """A value with its unit, where the unit is a length or an area."""
        return f"{number(value)} {self.unit}" if self.unit.startswith("scene units") else number(value)


def quantity(search: Search, score: Score) -> Quantity:
    """What the values of a search are, from the kinds of search and score."""
    if isinstance(search, FarthestView):
        meaning = "distance from a candidate to the nearest camera so far; the surface is not looked at."
        return Quantity("distance to the nearest camera", "scene units", meaning)
    if isinstance(search, RandomView):
        meaning = "every open candidate drew a lot; the surface is not looked at."
        return Quantity("lot drawn", "uniform on [0, 1)", meaning, smooth=False)
    if isinstance(search, UncertaintyView):
        meaning = "length of the principal ray along which the posterior samples disagree whether it has hit."
        return Quantity("uncertain length of the principal ray", "scene units", meaning)
    if isinstance(score, Coverage):
        meaning = "squared distances to the cloud, summed over an imagined scan, mean over posterior samples."
        return Quantity("expected coverage gain", "scene units²", meaning)
    if isinstance(score, CrossEntropy):
        meaning = "cross-entropy of the classes before and after an imagined scan, mean over posterior samples."
        return Quantity("expected cross-entropy", "nats", meaning)
    if isinstance(score, MixedEntropy):
        meaning = "expected cross-entropy, or expected reduction of entropy once the class is nearly settled."
        return Quantity("expected cross-entropy or reduction of entropy", "nats", meaning)
    if isinstance(score, ExpectedUtilityImprovement) and isinstance(score.utility, NegativeEntropy):
        meaning = "how much an imagined scan lowers the entropy of the classes, mean over posterior samples."
        return Quantity("expected reduction of entropy", "nats", meaning)
    if isinstance(score, ExpectedUtilityImprovement) and isinstance(score.utility, SoftPartCount):
        meaning = "how much an imagined scan raises the soft count of the parts, mean over posterior samples."
        return Quantity("expected gain in parts", "parts", meaning)
    if isinstance(score, ExpectedUtilityImprovement) and isinstance(score.utility, ColdestPoint):
        meaning = "how much colder than now the coldest point is with an imagined scan, mean over posterior samples."
        return Quantity("expected fall of the least temperature", "degrees", meaning)
    if isinstance(score, ExpectedUtilityImprovement):
        meaning = "how much an imagined scan raises the utility of the cloud, mean over posterior samples."
        return Quantity("expected utility improvement", "", meaning)
    meaning = "score of an imagined scan, mean over posterior samples."
    return Quantity(f"acquisition, {type(score).__name__}", "", meaning)


def describe_first(pose: Pose, points: int, covered: float | None) -> str:
    """What a view that was given saw, to follow "View 1"."""
    share = "" if covered is None else f", {percent(covered)} of the true surface"
    return f"was given. It looks from {place(pose)}, and found {points:,} points{share}."


def describe_choice(
    values: Quantity,
    value: float,
    rank: int,
    others: tuple[float, ...],
    starts: int,
    pose: Pose,
    earlier: list[Pose],
    points: int,
    count: int,
    change: tuple[float, float] | None,
) -> str:
    """Where a view looks from, why it was chosen and what it added, to follow "View 2".

    `others`: values of the open candidates, best first; `starts`: of a gradient search's ascents, else 0; `change`:
    coverage before and after, where it is known.
    """
    turned = f"{nearest_angle(pose, earlier):.0f}° from the nearest earlier view"
    parts = [f"looks from {place(pose)}{_aim(pose)}, {turned}.", _reason(values, value, rank, others, starts)]
    added = f"It added {points:,} points" if points else "It saw nothing"
    kept = f" ({count:,} are kept)" if points else ""
    grown = ""
    if change is not None:
        before, after = (percent(share) for share in change)
        grown = f"; coverage stayed at {after}" if before == after else f"; coverage went from {before} to {after}"
    return " ".join([*parts, f"{added}{kept}{grown}."])


def _reason(values: Quantity, value: float, rank: int, others: tuple[float, ...], starts: int) -> str:
    if not values.smooth:
        return f"It was drawn at random from {len(others)} open candidates."
    ascent = f"gradient ascent from {starts} start{'s' if starts > 1 else ''}"
    if starts and (not others or value > others[0]):
        text = f"Its {values.name}, {values.show(value)}, was found by {ascent}"
        if not others:
            return f"{text}."
        if len(others) == 1:
            return f"{text}: {_margin(value, others[0], 'the one open candidate')} ({number(others[0])})."
        margin = _margin(value, others[0], f"the best of {len(others)} open candidates")
        return f"{text}: {margin} ({number(others[0])}; median {number(float(np.median(others)))})."
    best = rank == 1
    stands = "the highest" if best else f"rank {rank}"
    text = f"Its {values.name}, {values.show(value)}, was {stands} of {len(others)} open candidates"
    after = f" The {ascent} found nothing better." if starts else ""
    median = float(np.median(others))
    compared = f"the median candidate had {number(median)}"
    if median > 0 and value / median < 1000:
        compared = f"{number(value / median)} times the median ({number(median)})"
    if not best or len(others) < 2:
        return f"{text}: {compared}.{after}"
    return f"{text}: {compared}, {_margin(value, others[1], 'the runner-up')} ({number(others[1])}).{after}"


def _margin(value: float, other: float, name: str) -> str:
    """How far a value is ahead of another, which has a name."""
    if other <= 0:
        return f"ahead of {name}"
    ahead = value / other - 1.0
    if ahead >= 1:
        return f"{number(ahead + 1)} times {name}"
    return f"level with {name}" if ahead < 5e-4 else f"{float(f'{100 * ahead:.2g}'):g} % above {name}"


def place(pose: Pose) -> str:
    """A camera's position and its elevation over the scene's horizon (y is up)."""
    position = np.asarray(pose.position, dtype=np.float64)
    elevation = np.degrees(np.arcsin(position[1] / max(float(np.linalg.norm(position)), 1e-12)))
    side = "above" if elevation >= 0 else "below"
    return f"{coordinates(position)}, {abs(elevation):.0f}° {side} the horizon"


def coordinates(point: Float[np.ndarray, "3"]) -> str:
    """A point in scene units."""
    x, y, z = (f"{coordinate:.2f}".replace("-", "−") for coordinate in point)
    return f"({x}, {y}, {z})"


def _aim(pose: Pose) -> str:
    """By how much a camera looks past the origin, where it does."""
    position, forward = (np.asarray(vector, dtype=np.float64) for vector in (pose.position, pose.forward))
    distance = float(np.linalg.norm(position))
    off = np.degrees(np.arccos(np.clip(-position @ forward / max(distance, 1e-12), -1.0, 1.0)))
    return "" if off < 0.5 else f", {distance:.2f} from the centre and aimed {off:.0f}° off it"


def nearest_angle(pose: Pose, earlier: list[Pose]) -> float:
    """Angle at the origin, in degrees, between a camera and the nearest of the others."""
    here, *others = (np.asarray(p.position, dtype=np.float64) for p in (pose, *earlier))
    cosines = [here @ there / (np.linalg.norm(here) * np.linalg.norm(there) + 1e-12) for there in others]
    return float(np.degrees(np.arccos(np.clip(max(cosines), -1.0, 1.0))))


def percent(share: float) -> str:
    """A share in whole percent."""
    return f"{100 * share:.0f} %"


def number(value: float) -> str:
    """Three significant digits, without an exponent where none is needed."""
    text = f"{value:,.0f}" if 999.5 <= abs(value) < 1e7 else f"{value:.3g}"
    return text.replace("-", "−")
