"""Sentences about each view: where it looks from, why it was chosen, and what it showed."""

from collections.abc import Sequence

import numpy as np

from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.pose import Pose
from jaxnbv.planning.loop import View
from jaxnbv.search import Proposal
from jaxnbv.utility import Quantity
from jaxnbv.viz.answers import CoverageAnswer, length_text, number_text, point_text, value_text
from jaxnbv.viz.choice import descending_values, directions_of
from jaxnbv.viz.sphere import unit


def sentences_about(
    quantity: Quantity,
    views: Sequence[View],
    amounts: Sequence[CoverageAnswer],
    frame: Frame,
    gain: float | None = None,
) -> dict[str, str]:
    """Return sentences about the last view by heading: pose, expected value, other candidates, result.

    - `views`: all views up to this one, with the values of their proposals in world units.
    - `amounts`: how much was seen after each view.
    - `gain`: actual gain of the last view in world units, to compare with its expected value.
    """
    *earlier, view = views
    points, amount = int(view.scan.count), amounts[-1].amount
    if view.proposal is None or not earlier:
        surface_text = "the true surface" if amounts[-1].unit == "%" else "surface"
        result = f"It found {points:,} points, {amount} of {surface_text}."
        return {"Where": f"This view was given. It looks from {pose_text(view.pose, frame)}.", "Result": result}
    direction, earlier_directions = directions_of(view.pose), np.stack([directions_of(other.pose) for other in earlier])
    nearest = np.degrees(np.arccos(np.clip((earlier_directions @ direction).max(), -1.0, 1.0)))
    added = f"It added {points:,} points ({int(view.cloud.count):,} are kept)" if points else "It saw nothing"
    if gain is not None:
        added += f", and its actual value was {value_text(quantity, gain, frame)}"
    before = amounts[-2].amount
    change = f"stayed at {amount}" if before == amount else f"went from {before} to {amount}"
    return {
        "Where": f"It looks from {pose_text(view.pose, frame)}, {nearest:.0f}° from the nearest earlier view.",
        **_reason(quantity, view.proposal, frame),
        "Result": f"{added}; {'coverage' if amounts[-1].unit == '%' else 'surface seen'} {change}.",
    }


def _reason(quantity: Quantity, proposal: Proposal, frame: Frame) -> dict[str, str]:
    """Return sentences, keyed by heading, about the value of a view and the values of the other candidates."""
    value, others, num_tied = float(proposal.value), descending_values(proposal).tolist(), proposal.num_tied
    if not quantity.smooth:
        return {"Why this view": f"It was drawn at random from {len(others)} candidates that are left."}
    is_ascent = proposal.trajectories is not None and (not others or value > others[0])
    rank = 1 + sum(other > value for other in others)
    reason = f"{'the highest' if rank == 1 else f'rank {rank}'} of {len(others)} candidates that are left"
    if rank > 1 and proposal.value_at_visited is not None:
        reason += ", and of those tied with the best the farthest from the cameras so far"
    if is_ascent and proposal.trajectories is not None:
        num_starts = len(proposal.trajectories.values)
        reason = f"found by gradient ascent from {num_starts} start{'s' * (num_starts > 1)}"
    # Print only areas and lengths, because readers do not know nats.
    amount = f"Its value, {value_text(quantity, value, frame)}," if quantity.length_power else "Its value"
    sentences = {"Why this view": f"{amount} was {reason}."}
    rest = others if is_ascent or rank > 1 else others[1:]
    if rest:
        visited_value = 0.0 if proposal.value_at_visited is None else float(proposal.value_at_visited)
        level = "two standard errors"
        if visited_value > 0:
            level += f" and {number_text(visited_value)}, expected even at earlier poses"
        tied_text = "" if num_tied is None else f"; {num_tied or 'no'} other{'s' * (num_tied != 1)} within {level}"
        other, median = "candidate" if is_ascent else "other", number_text(float(np.median(others)))
        sentences["Other candidates"] = f"Best {other} {number_text(rest[0])}, median {median}{tied_text}."
    return sentences


def pose_text(pose: Pose, frame: Frame) -> str:
    """Describe a pose in words: world position, elevation, and angle by which its axis misses the origin."""
    position, forward = (np.asarray(vector, dtype=np.float64) for vector in (pose.position, pose.forward))
    elevation = np.degrees(np.arcsin(unit(position)[1]))
    side = "above" if elevation >= 0 else "below"
    angle = np.degrees(np.arccos(np.clip(-unit(position) @ forward, -1.0, 1.0)))
    distance = length_text(frame.length_to_world(float(np.linalg.norm(position))), frame)
    aim = "" if angle < 0.5 else f", {distance} from the centre and aimed {angle:.0f}° off it"
    return f"{point_text(position, frame)}, {abs(elevation):.0f}° {side} the horizon{aim}"
