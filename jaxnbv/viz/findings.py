"""What is known of the object after a view, for the task that the views are for: a line and a sentence."""

from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Int

from jaxnbv.acquisition import ExpectedUtilityImprovement, Score
from jaxnbv.cloud import PointCloud
from jaxnbv.networks import CATEGORIES, CloudSegmenter
from jaxnbv.tasks import ColdestPoint, Segmenter, SoftPartCount, coldest_point, part_counts
from jaxnbv.tasks.classification import class_names, predict
from jaxnbv.viz.words import coordinates, number


class Finding(NamedTuple):
    """What a view told.

    - `line`: for the terminal.
    - `sentence`: for the report.
    - `values`: the numbers that the next view's finding is compared with: probabilities of classes, points of parts.
    """

    line: str
    sentence: str
    values: Float[np.ndarray, " n"]


def finding(score: Score, cloud: PointCloud, before: Finding | None) -> Finding | None:
    """What D tells, beside what it told before the view; None for a task that has no answer but its cloud."""
    log_p = predict(score, cloud)
    if log_p is not None:
        return _classes(np.exp(np.asarray(log_p, np.float64)), class_names(score), before)
    utility = score.utility if isinstance(score, ExpectedUtilityImprovement) else None
    if isinstance(utility, SoftPartCount):
        return _parts(utility.segmenter, cloud, before)
    return _coldest(utility, cloud, before) if isinstance(utility, ColdestPoint) else None


def _classes(after: np.ndarray, names: tuple[str, ...] | None, before: Finding | None) -> Finding:
    names = tuple(f"class {index}" for index in range(len(after))) if names is None else names
    best = int(np.argmax(after))
    sentence = f"The classifier says {names[best]} with probability {after[best]:.2f}"
    if before is not None:
        previous = int(np.argmax(before.values))
        was = f"was {before.values[best]:.2f}"
        behind = "" if best == previous else f", behind {names[previous]} with {before.values[previous]:.2f}"
        sentence += f" ({was}{behind})"
    shown = sorted(np.argsort(-after)[:5])
    return Finding(_changes(names, after, before, shown, "{:.2f}"), f"{sentence}.", after)


def _parts(segmenter: Segmenter, cloud: PointCloud, before: Finding | None) -> Finding:
    counts = np.asarray(_count(segmenter, cloud), np.float64)
    names = tuple(f"part {index}" for index in range(len(counts)))
    shown = np.flatnonzero(counts > 0).tolist()
    if isinstance(segmenter, CloudSegmenter):
        category = CATEGORIES[int(segmenter.category)]
        names = tuple(
            category.parts[index - category.first_label] if index in category.labels else name
            for index, name in enumerate(names)
        )
        shown = list(category.labels)
    listed = ", ".join(f"{names[c]} {counts[c]:.0f}" for c in shown) or "none"
    sentence = f"Points predicted of each part: {listed}."
    return Finding(_changes(names, counts, before, shown, "{:.0f}"), sentence, counts)


def _coldest(utility: ColdestPoint, cloud: PointCloud, before: Finding | None) -> Finding:
    point, temperature = coldest_point(cloud, utility.heat, utility.reached_only)
    change = "" if before is None else f" (was {number(float(before.values[0]))})"
    text = f"coldest at {coordinates(point)}, {number(temperature)} degrees{change}"
    return Finding(text, f"The cloud is {text}.", np.array([temperature]))


def _changes(names, after: np.ndarray, before: Finding | None, shown, form: str) -> str:
    def one(index):
        was = "" if before is None else f"{form.format(before.values[index])} -> "
        return f"{names[index]} {was}{form.format(after[index])}"

    return "   ".join(map(one, shown))


@eqx.filter_jit
def _count(segmenter: Segmenter, cloud: PointCloud) -> Int[Array, " parts"]:
    return part_counts(segmenter(cloud))
