"""What happened at every view, in words."""

from typing import NamedTuple

import numpy as np

from jaxnbv.acquisition import Quantity
from jaxnbv.geometry.pose import Pose
from jaxnbv.viz.answers import CoverageAnswer, coordinates, number, shown_value
from jaxnbv.viz.choice import Choice
from jaxnbv.viz.sphere import unit


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


def describe_first(pose: Pose, points: int, seen: CoverageAnswer) -> Told:
    """A view that was given."""
    of = "the true surface" if seen.is_share else "surface"
    return Told(
        f"was given. It looks from {place(pose)}", "", "", f"It found {points:,} points, {seen.amount} of {of}."
    )


def describe_choice(
    quantity: Quantity,
    choice: Choice,
    pose: Pose,
    earlier: list[Pose],
    points: int,
    count: int,
    seen: tuple[CoverageAnswer, CoverageAnswer],
) -> Told:
    """A view that was chosen.

    `points`, `count`: those that it found, and those that are kept; `seen`: how much was seen before and after.
    """
    here, *others = (unit(np.asarray(p.position, dtype=np.float64)) for p in (pose, *earlier))
    nearest = np.degrees(np.arccos(np.clip(max(here @ there for there in others), -1.0, 1.0)))
    turned = f"{nearest:.0f}° from the nearest earlier view"
    added = f"It added {points:,} points" if points else "It saw nothing"
    kept = f" ({count:,} are kept)" if points else ""
    (before, after), what = (one.figure for one in seen), "coverage" if seen[1].is_share else "surface seen"
    grown = f"; {what} " + ("stayed at" if before == after else f"went from {before} to") + f" {seen[1].amount}"
    where, came = f"looks from {place(pose)}{_aim(pose)}, {turned}", f"{added}{kept}{grown}."
    return Told(where, *_reason(quantity, choice), came)


def _reason(quantity: Quantity, choice: Choice) -> tuple[str, str]:
    """What was expected of a view, and how that stands beside the other candidates."""
    value, others = choice.value, choice.open_values.tolist()
    if not quantity.smooth:
        return f"It was drawn at random from {len(others)} open candidates", ""
    starts = 0 if choice.ascents is None else len(choice.ascents.values)
    climbed = starts > 0 and (not others or value > others[0])
    rank = "the highest" if choice.rank == 1 else f"rank {choice.rank}"
    found = f"found by gradient ascent from {starts} start{'s' * (starts > 1)}"
    how = found if climbed else f"{rank} of {len(others)} open candidates"
    text = f"Its {quantity.name}, {shown_value(quantity, value)}, was {how}"
    rest = others if climbed or choice.rank > 1 else others[1:]
    if not rest:
        return text, ""
    compared = (
        f"best {'candidate' if climbed else 'other'} {number(rest[0])}, median {number(float(np.median(others)))}"
    )
    if choice.num_tied is None:
        return text, compared
    many = (
        "no other is" if choice.num_tied == 0 else f"{choice.num_tied} other{'s are' if choice.num_tied > 1 else ' is'}"
    )
    return text, f"{compared}; {many} within two standard errors of the best"


def place(pose: Pose) -> str:
    """A camera's position and its elevation over the scene's horizon (y is up)."""
    position = np.asarray(pose.position, dtype=np.float64)
    elevation = np.degrees(np.arcsin(unit(position)[1]))
    side = "above" if elevation >= 0 else "below"
    return f"{coordinates(position)}, {abs(elevation):.0f}° {side} the horizon"


def _aim(pose: Pose) -> str:
    """By how much a camera looks past the origin, where it does."""
    position, forward = (np.asarray(vector, dtype=np.float64) for vector in (pose.position, pose.forward))
    off = np.degrees(np.arccos(np.clip(-unit(position) @ forward, -1.0, 1.0)))
    return "" if off < 0.5 else f", {np.linalg.norm(position):.2f} from the centre and aimed {off:.0f}° off it"
