"""What studies of classification measure: hits by view, what views have shown, and how good the samples were."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from jaxnbv.studies.classification.hits import (
    CUE_PIXELS,
    cumulative_share,
    first_hit,
    random_seen_share,
    seen_view,
    stable_hit,
)
from jaxnbv.studies.engine.measures import Measure, Record
from jaxnbv.studies.engine.study import Chart, Panel

_CHOSEN = "view being chosen"
HITS_EXPLAINED = (
    "First hit: a right prediction so far. Stable hit: right from then to the end. Random search: exact\n"
    "expectation of first hit by view 2, and of what a view shows; else a mean over runs.\n"
)


def seen_explained(cue: str) -> str:
    """What having seen it means."""
    return f"{cue.capitalize()} seen: one of the views shows at least {CUE_PIXELS} pixels of it."


def _hit(time_of: Callable) -> Callable[[Record, str], Float[np.ndarray, " views"]]:
    """The share of a method's runs that have hit, by view: for all but random search that of one run, 0 or 1."""

    def of(record: Record, method: str) -> Float[np.ndarray, " views"]:
        held = record["methods"][method]
        correct = [np.argmax(run["log_p"], axis=1) == record["label"] for run in held["runs"]]
        share = cumulative_share([time_of(run) for run in correct], len(correct[0]))
        if method == "random" and time_of is first_hit and len(share) >= 2:
            # Exact by view 2; all runs have the first view in common.
            share[1] = 1.0 if correct[0][0] else held["hit"]
        return share

    return of


def _seen(cue: str) -> Callable[[Record, str], Float[np.ndarray, " views"]]:
    """Whether a view has shown the cue of the class, by view; of random search the exact share over all orders."""

    def of(record: Record, method: str) -> Float[np.ndarray, " views"]:
        runs, pixels = record["methods"][method]["runs"], f"{cue}_pixels"
        views = len(runs[0]["log_p"])
        if method == "random":
            return random_seen_share(np.array(record[pixels]), record["first"], views)
        return cumulative_share([seen_view(np.array(run[pixels])) for run in runs], views)

    return of


def _diagnostic(quantity: str) -> Callable[[Record, str], list[float | None]]:
    """By the view being chosen; of the posterior that the method's own views made."""

    def of(record: Record, method: str) -> list[float | None]:
        views = len(record["methods"][method]["runs"][0]["log_p"])
        return [_of_view(record, method, quantity, view) for view in range(2, views + 1)]

    return of


def _of_view(record: Record, method: str, quantity: str, view: int) -> float | None:
    found = [entry[quantity] for entry in record["methods"][method]["diagnostics"] if entry["view"] == view]
    return found[0] if found and found[0] is not None and np.isfinite(found[0]) else None


def diagnostic(name: str, title: str) -> Measure:
    """A measure of the samples among which a view is chosen."""
    return Measure(name, title, _diagnostic(name), first=2, digits=2, paired=False)


def hits(cue: str = "") -> tuple[Measure, ...]:
    """First and stable hit; and whether a view has shown the cue of the class, where that is a part of the object."""
    seen = Measure(cue, f"{cue.capitalize()} seen", _seen(cue), percent=True)
    both = [Measure(f.__name__.partition("_")[0], _HIT_TITLES[f], _hit(f), percent=True) for f in _HIT_TITLES]
    return (*both, seen) if cue else tuple(both)


_HIT_TITLES = {first_hit: "First hit", stable_hit: "Stable hit"}
ROUGHNESS = diagnostic("roughness", "Roughness")


def diagnostics_chart(*measures: str) -> Chart:
    """Measures by the view being chosen, beside each other."""
    return Chart((tuple(Panel(measure, axis=_CHOSEN) for measure in measures),))
