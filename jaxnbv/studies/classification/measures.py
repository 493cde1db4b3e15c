"""Measures of classification studies: correct predictions, visible cues, samples, and values of views.

The cue is the part of an object that tells its class.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Real
from scipy.stats import spearmanr

from jaxnbv.checks import AnyArray
from jaxnbv.sampler import StepInputs, SurfaceSampler
from jaxnbv.studies.engine.measures import SECONDS, Measure, Record

# A view shows the cue if at least this many of its rays hit the cue.
CUE_PIXELS = 150
# Methods that maximise expected cross-entropy, so that their values can be compared.
_BY_CROSS_ENTROPY = ("cross-entropy", "tie-break", "halving", "gradient-2dof", "gradient-constrained", "hybrid")


def first_hits(correct: Bool[np.ndarray, "runs views"]) -> Bool[np.ndarray, "runs views"]:
    """Return whether any prediction up to each view is correct: true from the paper's T_first on."""
    return np.logical_or.accumulate(correct, axis=1)


def stable_hits(correct: Bool[np.ndarray, "runs views"]) -> Bool[np.ndarray, "runs views"]:
    """Return whether all predictions from each view on are correct: true from the paper's T_stable on."""
    return np.logical_and.accumulate(correct[:, ::-1], axis=1)[:, ::-1]


def _hit_fraction(hits: Callable) -> Callable[[Record, str], Float[np.ndarray, " views"]]:
    """Return a function from record and method to the fraction of runs with a hit at each view.

    Only "random" has several runs. `hits` is `first_hits` or `stable_hits`.
    """

    def compute(record: Record, method: str) -> Float[np.ndarray, " views"]:
        guesses = np.argmax(record["methods"][method]["log_p"], axis=-1)
        return hits(guesses == record["label"]).mean(axis=0)

    return compute


def _cue_seen(record: Record, method: str) -> Float[np.ndarray, " views"] | list:
    """Return the fraction of runs that have shown the cue by each view; [] for objects without a cue."""
    pixels = record["methods"][method]["pixels"]
    return first_hits(np.array(pixels) >= CUE_PIXELS).mean(axis=0) if pixels else []


def _value(record: Record, method: str) -> dict[int, float]:
    steps = record["methods"][method].get("steps", []) if method in _BY_CROSS_ENTROPY else []
    return {view: step["value"] for view, step in enumerate(steps, start=2)}


def roughness(sampler: SurfaceSampler, inputs: StepInputs) -> float:
    """Return the roughness of the samples in `inputs`.

    This is the average number of grid cells that a sample's surface crosses, divided by the number of cells that the
    surface of the posterior mean crosses. The mean is carved like the samples. If it has no closed form, the mean
    of the samples takes its place. Samples as smooth as the mean have a roughness of about 1. The roughness grows if
    the data are farther apart than the kernel's width. Near 5, an acquisition says little about which view is best.
    """
    posterior, surfaces = inputs.posterior, inputs.surfaces
    assert posterior is not None
    assert surfaces is not None
    values, has_closed_form = np.asarray(surfaces.values), posterior.has_closed_forms
    mean = np.asarray(sampler.mean(inputs.observations, posterior)) if has_closed_form else values.mean(axis=0)
    counts = [crossed_cells(sample) for sample in values]
    return float(np.mean(counts)) / max(crossed_cells(mean), 1)


def crossed_cells(values: Float[np.ndarray, "g g g"]) -> int:
    """Return the number of grid cells whose eight corners do not all have the same sign."""
    is_inside = values < 0
    size = is_inside.shape[0] - 1
    corners = [is_inside[i : i + size, j : j + size, k : k + size] for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    return int(np.sum(np.any(corners, axis=0) & ~np.all(corners, axis=0)))


def rank_correlation(
    values: Float[AnyArray, " c"], true_values: Real[AnyArray, " c"], is_compared: Bool[np.ndarray, " c"]
) -> float | None:
    """Return Spearman's rank correlation over the candidates of a mask; None if either array is constant."""
    a, b = np.asarray(values)[is_compared], np.asarray(true_values)[is_compared]
    return None if np.ptp(a) == 0 or np.ptp(b) == 0 else float(spearmanr(a, b).statistic)


MEASURES = (
    Measure("first", "First hit", _hit_fraction(first_hits), unit="%"),
    Measure("stable", "Stable hit", _hit_fraction(stable_hits), unit="%"),
    Measure("seen", "Cue seen", _cue_seen, unit="%"),
    Measure("rank_correlation", "Rank correlation", lambda r, m: r["methods"][m]["rank_correlation"], digits=2),
    Measure("roughness", "Roughness", lambda r, m: r["methods"][m]["roughness"], digits=2, lower_is_better=True),
    Measure("value", "Expected cross-entropy", _value, unit="nats"),
    SECONDS,
)
