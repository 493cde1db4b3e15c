"""What happened at every view, in words."""

from typing import NamedTuple

import numpy as np

from jaxnbv.acquisition import Quantity
from jaxnbv.geometry.pose import Pose
from jaxnbv.viz.answers import coordinates, number, shown_value


class Told(NamedTuple):
    """What happened at a view, in four parts, "" for one that there is not: where it looks from, what was expected of
    it, how that stands beside the other candidates, what came."""

    where: str
    expected: str
    others: str
    came: str

    def sentence(self, view: int) -> str:
        """All of it as one text, that starts with the view's number."""
        why = ": ".join(part for part in (self.expected, self.others) if part)
        return " ".join(part for part in (f"View {view} {self.where}.", why and f"{why}.", self.came) if part)


def describe_first(pose: Pose, points: int, covered: float | None) -> Told:
    """A view that was given."""
    share = "" if covered is None else f", {percent(covered)} of the true surface"
    return Told(f"was given. It looks from {place(pose)}", "", "", f"It found {points:,} points{share}.")


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
    num_tied: int | None = None,
) -> Told:
    """A view that was chosen.

    `others`: values of the open candidates, best first; `starts`: of a gradient search's ascents, else 0; `change`:
    coverage before and after, where it is known; `num_tied`: how many others are tied with the best.
    """
    turned = f"{nearest_angle(pose, earlier):.0f}° from the nearest earlier view"
    added = f"It added {points:,} points" if points else "It saw nothing"
    kept = f" ({count:,} are kept)" if points else ""
    grown = ""
    if change is not None:
        before, after = (percent(share) for share in change)
        grown = f"; coverage stayed at {after}" if before == after else f"; coverage went from {before} to {after}"
    why = _reason(values, value, rank, others, starts, num_tied)
    return Told(f"looks from {place(pose)}{_aim(pose)}, {turned}", *why, f"{added}{kept}{grown}.")


def _reason(
    values: Quantity, value: float, rank: int, others: tuple[float, ...], starts: int, num_tied: int | None
) -> tuple[str, str]:
    if not values.smooth:
        return f"It was drawn at random from {len(others)} open candidates", ""
    ascent = f"gradient ascent from {starts} start{'s' if starts > 1 else ''}"
    if starts and (not others or value > others[0]):
        text = f"Its {values.name}, {shown_value(values, value)}, was found by {ascent}"
        if not others:
            return text, ""
        if len(others) == 1:
            return text, f"{_margin(value, others[0], 'the one open candidate')} ({number(others[0])})"
        margin = _margin(value, others[0], f"the best of {len(others)} open candidates")
        return text, f"{margin} ({number(others[0])}; median {number(float(np.median(others)))})"
    best = rank == 1
    stands = "the highest" if best else f"rank {rank}"
    text = f"Its {values.name}, {shown_value(values, value)}, was {stands} of {len(others)} open candidates"
    after = f". The {ascent} found nothing better" if starts else ""
    median = float(np.median(others))
    compared = f"the median candidate had {number(median)}"
    if median > 0 and value / median < 1000:
        compared = f"{number(value / median)} times the median ({number(median)})"
    tied = "" if num_tied is None or len(others) < 2 else f". {tie_sentence(num_tied, best)}"
    if not best:
        return text, f"{compared}, the best {number(others[0])}{tied}{after}"
    if len(others) < 2:
        return text, f"{compared}{after}"
    margin = _margin(value, others[1], "the runner-up")
    return text, f"{compared}, {margin} ({number(others[1])}){tied}{after}"


def tie_sentence(num_tied: int, chosen: bool = True) -> str:
    """Whether the best candidate, be it the chosen one or not, stands out, or so many others are tied with it."""
    best = "it" if chosen else "the best"
    if not num_tied:
        return f"{best.capitalize()} stands out: no other is within two standard errors of it"
    others = f"{num_tied} other{'s' if num_tied > 1 else ''}"
    return f"By the samples {best} cannot be told from {others}, within two standard errors"


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
