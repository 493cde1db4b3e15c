"""When a sequence of views first gives the right class, gives it for good, or first shows its cue.

Views count from 1. A sequence that never does has no such time: None.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Integer

from jaxnbv.checks import AnyArray, require

# What the studies call having seen it: rays of one scan that hit the cue of the class.
CUE_PIXELS = 150


def first_hit(correct: Bool[AnyArray, " views"]) -> int | None:
    """The earliest view with a correct prediction, the paper's T_first."""
    hits = np.flatnonzero(correct)
    return int(hits[0]) + 1 if hits.size else None


def stable_hit(correct: Bool[AnyArray, " views"]) -> int | None:
    """The earliest view from which on the prediction stays correct to the end, the paper's T_stable."""
    misses = np.flatnonzero(~np.asarray(correct))
    view = int(misses[-1]) + 2 if misses.size else 1
    return view if view <= len(correct) else None


def seen_view(pixels: Integer[AnyArray, " views"], threshold: int = CUE_PIXELS) -> int | None:
    """The first view in which at least `threshold` rays hit the cue of the class; views do not add up."""
    return first_hit(np.asarray(pixels) >= threshold)


def cumulative_share(times: Sequence[int | None], views: int) -> Float[np.ndarray, " views"]:
    """Share of the sequences whose time is at most 1, 2, ..., `views`; one that never hits counts in the whole.

    **Raises:** `ValueError` if there are no times.
    """
    require(len(times) > 0, "a share of no sequences is not defined: give at least one time")
    by_view = np.array([np.inf if time is None else time for time in times])
    return np.mean(by_view[:, None] <= np.arange(1, views + 1), axis=0)


def random_seen_share(
    pixels: Integer[AnyArray, " candidates"], first: int, views: int, threshold: int = CUE_PIXELS
) -> Float[np.ndarray, " views"]:
    """Exact probability that a random search has shown the cue of the class by view 1, 2, ..., `views`.

    After the first camera it takes the other N candidates in an order drawn uniformly without replacement. Of these M
    show it, so by view t it has missed them all with the hypergeometric probability
    C(N - M, t - 1) / C(N, t - 1). If the first camera shows it, the share is 1 throughout.

    - `pixels`: for each candidate the rays of its true scan that hit the cue of the class.
    - `first`: the first camera, an index of the candidates.

    **Raises:** `ValueError` if there is no such candidate, or there are more views than candidates.
    """
    shows = np.asarray(pixels) >= threshold
    require(0 <= first < len(shows), f"the first camera is candidate {first} of {len(shows)}; count from 0")
    require(1 <= views <= len(shows), f"{views} views of {len(shows)} candidates: each is taken at most once")
    if shows[first]:
        return np.ones(views)
    others, showing = len(shows) - 1, int(shows.sum())
    drawn = np.arange(views - 1)
    miss = np.maximum(others - showing - drawn, 0) / (others - drawn)
    return 1.0 - np.cumprod(np.append(1.0, miss))
