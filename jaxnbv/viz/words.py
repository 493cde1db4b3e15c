"""Sentences about each view: where it looks from, why it was chosen, and what it showed."""

from collections.abc import Sequence

import numpy as np

from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.pose import Pose
from jaxnbv.planning.loop import View
from jaxnbv.search import Proposal
from jaxnbv.utility import Quantity
from jaxnbv.viz.answers import CoverageAnswer, coordinates, fixed, number, shown_value
from jaxnbv.viz.choice import best_first, directions_of
from jaxnbv.viz.sphere import unit


def told(
    quantity: Quantity,
    views: Sequence[View],
    seen: Sequence[CoverageAnswer],
    frame: Frame,
    gain: float | None = None,
) -> dict[str, str]:
    """Return sentences about the last view, by heading: pose, expected value, other candidates, result.

    - `views`: all views up to this one, with the values of their proposals in world units.
    - `seen`: how much was seen after each view.
    - `frame`: frame of the world.
    - `gain`: true gain of the last view, to compare with its expected value, in world units; None if unknown.
    """
    *earlier, view = views
    points, amount = int(view.scan.count), seen[-1].amount
    if view.proposal is None or not earlier:
        of = "the true surface" if seen[-1].unit == "%" else "surface"
        result = f"It found {points:,} points, {amount} of {of}."
        return {"Where": f"It was given. It looks from {place(view.pose, frame)}.", "What came": result}
    here, there = directions_of(view.pose), np.stack([directions_of(other.pose) for other in earlier])
    nearest = np.degrees(np.arccos(np.clip((there @ here).max(), -1.0, 1.0)))
    added = f"It added {points:,} points ({int(view.cloud.count):,} are kept)" if points else "It saw nothing"
    if gain is not None:
        added += f", and {shown_value(quantity, gain, frame)} of what it promised"
    before = seen[-2].amount
    grown = f"stayed at {amount}" if before == amount else f"went from {before} to {amount}"
    return {
        "Where": f"It looks from {place(view.pose, frame)}, {nearest:.0f}° from the nearest earlier view.",
        **_reason(quantity, view.proposal, frame),
        "What came": f"{added}; {'coverage' if seen[-1].unit == '%' else 'surface seen'} {grown}.",
    }


def _reason(quantity: Quantity, proposal: Proposal, frame: Frame) -> dict[str, str]:
    """Return sentences, by heading, about the value of a view and the values of the other candidates."""
    value, others, tied = float(proposal.value), best_first(proposal).tolist(), proposal.num_tied
    if not quantity.smooth:
        return {"What it promised": f"It was drawn at random from {len(others)} open candidates."}
    climbed = proposal.trajectories is not None and (not others or value > others[0])
    rank = 1 + sum(other > value for other in others)
    how = f"{'the highest' if rank == 1 else f'rank {rank}'} of {len(others)} open candidates"
    if rank > 1 and proposal.value_at_visited is not None:
        how += ", and of those tied with the best the farthest from the cameras so far"
    if climbed and proposal.trajectories is not None:
        starts = len(proposal.trajectories.values)
        how = f"found by gradient ascent from {starts} start{'s' * (starts > 1)}"
    # Print only areas and lengths, because readers do not know nats.
    amount = f"Its value, {shown_value(quantity, value, frame)}," if quantity.length_power else "Its value"
    said = {"What it promised": f"{amount} was {how}."}
    rest = others if climbed or rank > 1 else others[1:]
    if rest:
        vain = 0.0 if proposal.value_at_visited is None else float(proposal.value_at_visited)
        level = "two standard errors" + (f" and {number(vain)}, expected even at earlier poses" if vain > 0 else "")
        many = "" if tied is None else f"; {tied or 'no'} other{'s' * (tied != 1)} within {level}"
        other, median = "candidate" if climbed else "other", number(float(np.median(others)))
        said["Beside the others"] = f"Best {other} {number(rest[0])}, median {median}{many}."
    return said


def place(pose: Pose, frame: Frame) -> str:
    """Describe a pose in words: world coordinates, elevation, and the angle by which it misses the origin."""
    position, forward = (np.asarray(vector, dtype=np.float64) for vector in (pose.position, pose.forward))
    elevation = np.degrees(np.arcsin(unit(position)[1]))
    side = "above" if elevation >= 0 else "below"
    off = np.degrees(np.arccos(np.clip(-unit(position) @ forward, -1.0, 1.0)))
    away = fixed(frame.length_to_world(float(np.linalg.norm(position))), frame)
    aim = "" if off < 0.5 else f", {away} from the centre and aimed {off:.0f}° off it"
    return f"{coordinates(position, frame)}, {abs(elevation):.0f}° {side} the horizon{aim}"
