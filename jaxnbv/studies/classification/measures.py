"""What studies of classification measure: hits by view, what views have shown, and how good the samples were.

A hit is when a sequence of views first gives the right class, gives it for good, or first shows its cue. Views count
from 1.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Integer

from jaxnbv.checks import AnyArray, require
from jaxnbv.studies.engine.measures import Measure, Record
from jaxnbv.studies.engine.study import Chart, Panel

# What the studies call having seen it: rays of one scan that hit the cue of the class.
CUE_PIXELS = 150
HITS_EXPLAINED = (
    "First hit: a right prediction so far. Stable hit: right from then to the end. Random search: exact\n"
    "expectation of first hit by view 2, and of what a view shows; else a mean over runs.\n"
)


def seen_explained(cue: str) -> str:
    """What having seen it means."""
    return f"{cue.capitalize()} seen: one of the views shows at least {CUE_PIXELS} pixels of it."


def hits(cue: str = "") -> tuple[Measure, ...]:
    """First and stable hit; and whether a view has shown the cue of the class, where that is a part of the object."""
    first = Measure("first", "First hit", _hit(first_hits), percent=True)
    stable = Measure("stable", "Stable hit", _hit(stable_hits), percent=True)
    seen = Measure(cue, f"{cue.capitalize()} seen", _seen(cue), percent=True)
    return (first, stable, seen) if cue else (first, stable)


def hits_and_diagnostics(cue: str = "") -> tuple[Measure, ...]:
    """With the measures of the samples among which a view is chosen."""
    titles = {"rank_correlation": "Rank correlation"} if cue else {}
    return *hits(cue), *(
        Measure(name, title, _diagnostic(name), first=2, digits=2, paired=False)
        for name, title in (titles | {"roughness": "Roughness"}).items()
    )


def charts_of(cue: str = "", by_group: str = "") -> dict[str, Chart]:
    """Of the same; that of the hits once more by the groups of scenes, under a name of its own."""
    shown = (tuple(Panel(name) for name in ("first", "stable", cue) if name),)
    names = ("rank_correlation", "roughness") if cue else ("roughness",)
    diagnostics = (tuple(Panel(name, axis="view being chosen") for name in names),)
    groups = {by_group: Chart(shown, by_group=True)} if by_group else {}
    return {"hits": Chart(shown), **groups, "diagnostics": Chart(diagnostics)}


def _hit(by_view: Callable) -> Callable[[Record, str], Float[np.ndarray, " views"]]:
    """The share of a method's runs that have hit, by view: for all but random search that of one run, 0 or 1."""

    def of(record: Record, method: str) -> Float[np.ndarray, " views"]:
        held = record["methods"][method]
        correct = np.array([np.argmax(run["log_p"], axis=1) == record["label"] for run in held["runs"]])
        share = by_view(correct).mean(axis=0)
        if method == "random" and by_view is first_hits and len(share) >= 2:
            # Exact by view 2; all runs have the first view in common.
            share[1] = 1.0 if correct[0, 0] else held["hit"]
        return share

    return of


def _seen(cue: str) -> Callable[[Record, str], Float[np.ndarray, " views"]]:
    """Whether a view has shown the cue of the class, by view; of random search the exact share over all orders."""

    def of(record: Record, method: str) -> Float[np.ndarray, " views"]:
        runs, pixels = record["methods"][method]["runs"], f"{cue}_pixels"
        if method == "random":
            return random_seen_share(np.array(record[pixels]), record["first"], len(runs[0]["log_p"]))
        return first_hits(np.array([run[pixels] for run in runs]) >= CUE_PIXELS).mean(axis=0)

    return of


def _diagnostic(quantity: str) -> Callable[[Record, str], list[float | None]]:
    """By the view being chosen; of the posterior that the method's own views made."""

    def of(record: Record, method: str) -> list[float | None]:
        held = record["methods"][method]
        found = {entry["view"]: entry[quantity] for entry in held["diagnostics"]}
        by_view = [found.get(view) for view in range(2, len(held["runs"][0]["log_p"]) + 1)]
        return [one if one is not None and np.isfinite(one) else None for one in by_view]

    return of


def first_hits(correct: Bool[np.ndarray, "runs views"]) -> Bool[np.ndarray, "runs views"]:
    """Whether a prediction was correct by each view: from the paper's T_first on."""
    return np.logical_or.accumulate(correct, axis=1)


def stable_hits(correct: Bool[np.ndarray, "runs views"]) -> Bool[np.ndarray, "runs views"]:
    """Whether predictions are correct from each view to the end: from the paper's T_stable on."""
    return np.logical_and.accumulate(correct[:, ::-1], axis=1)[:, ::-1]


def random_seen_share(pixels: Integer[AnyArray, " candidates"], first: int, views: int) -> Float[np.ndarray, " views"]:
    """Exact probability that a random search has shown the cue of the class by view 1, 2, ..., `views`.

    After the first camera it takes the other N candidates in an order drawn uniformly without replacement. Of these M
    show it, so by view t it has missed them all with the hypergeometric probability
    C(N - M, t - 1) / C(N, t - 1). If the first camera shows it, the share is 1 throughout.

    - `pixels`: for each candidate the rays of its true scan that hit the cue of the class.
    - `first`: the first camera, an index of the candidates.

    **Raises:** `ValueError` if there is no such candidate, or there are more views than candidates.
    """
    shows = np.asarray(pixels) >= CUE_PIXELS
    require(0 <= first < len(shows), f"the first camera is candidate {first} of {len(shows)}; count from 0")
    require(1 <= views <= len(shows), f"{views} views of {len(shows)} candidates: each is taken at most once")
    if shows[first]:
        return np.ones(views)
    others, showing = len(shows) - 1, int(shows.sum())
    drawn = np.arange(views - 1)
    miss = np.maximum(others - showing - drawn, 0) / (others - drawn)
    return 1.0 - np.cumprod(np.append(1.0, miss))
