"""What happened at every view, in words."""

from typing import NamedTuple

import numpy as np

from jaxnbv.acquisition import Quantity
from jaxnbv.geometry.pose import Pose
from jaxnbv.viz.answers import CoverageAnswer, capital, coordinates, number, shown_value
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
    ascent = f"gradient ascent from {starts} start{'s' if starts > 1 else ''}"
    text = f"Its {quantity.name}, {shown_value(quantity, value)}, was"
    if starts and not others:
        return f"{text} found by {ascent}", ""
    median = float(np.median(others))
    if starts and value > others[0]:
        text = f"{text} found by {ascent}"
        if len(others) == 1:
            return text, f"{_margin(value, others[0], 'the one open candidate')} ({number(others[0])})"
        margin = _margin(value, others[0], f"the best of {len(others)} open candidates")
        return text, f"{margin} ({number(others[0])}; median {number(median)})"
    best = choice.rank == 1
    text = f"{text} {'the highest' if best else f'rank {choice.rank}'} of {len(others)} open candidates"
    compared = f"the median candidate had {number(median)}"
    if median > 0 and value / median < 1000:
        compared = f"{number(value / median)} times the median ({number(median)})"
    runner_up = ""
    if not best:
        runner_up = f", the best {number(others[0])}"
    elif len(others) > 1:
        runner_up = f", {_margin(value, others[1], 'the runner-up')} ({number(others[1])})"
    tied, it, level = "", "it" if best else "the best", choice.num_tied
    if level == 0 and len(others) > 1:
        tied = f". {capital(it)} stands out: no other is within two standard errors of it"
    elif level and len(others) > 1:
        equals = f"{level} other{'s' if level > 1 else ''}"
        tied = f". By the samples {it} cannot be told from {equals}, within two standard errors"
    after = f". The {ascent} found nothing better" if starts else ""
    return text, f"{compared}{runner_up}{tied}{after}"


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
    elevation = np.degrees(np.arcsin(unit(position)[1]))
    side = "above" if elevation >= 0 else "below"
    return f"{coordinates(position)}, {abs(elevation):.0f}° {side} the horizon"


def _aim(pose: Pose) -> str:
    """By how much a camera looks past the origin, where it does."""
    position, forward = (np.asarray(vector, dtype=np.float64) for vector in (pose.position, pose.forward))
    off = np.degrees(np.arccos(np.clip(-unit(position) @ forward, -1.0, 1.0)))
    return "" if off < 0.5 else f", {np.linalg.norm(position):.2f} from the centre and aimed {off:.0f}° off it"
