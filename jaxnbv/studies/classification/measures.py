"""Measures of classification studies: hits, visible cues, and the quality of samples and values.

A view, counted from 1, is a first hit if the right class was predicted up to it, and a stable hit if the right class is
predicted from it to the end.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Real
from scipy.stats import spearmanr

from jaxnbv.checks import AnyArray
from jaxnbv.sampler import StepInputs, SurfaceSampler
from jaxnbv.studies.engine.measures import SECONDS, Measure, Record

# A view shows the cue of the class if at least this number of its rays hits it.
CUE_PIXELS = 150
# Methods that share the acquisition cross-entropy, so that their values are comparable.
_BY_CROSS_ENTROPY = ("cross-entropy", "halving", "gradient-2dof", "gradient-constrained", "hybrid")


def first_hits(correct: Bool[np.ndarray, "runs views"]) -> Bool[np.ndarray, "runs views"]:
    """Whether any prediction up to each view was correct, which holds from the paper's T_first on."""
    return np.logical_or.accumulate(correct, axis=1)


def stable_hits(correct: Bool[np.ndarray, "runs views"]) -> Bool[np.ndarray, "runs views"]:
    """Whether all predictions from each view on are correct, which holds from the paper's T_stable on."""
    return np.logical_and.accumulate(correct[:, ::-1], axis=1)[:, ::-1]


def _hit(by_view: Callable) -> Callable[[Record, str], Float[np.ndarray, " views"]]:
    """The share of a method's runs with a hit, by view. Only random search has several runs."""

    def of(record: Record, method: str) -> Float[np.ndarray, " views"]:
        guesses = np.argmax(record["methods"][method]["log_p"], axis=-1)
        return by_view(guesses == record["label"]).mean(axis=0)

    return of


def _seen(record: Record, method: str) -> Float[np.ndarray, " views"] | list:
    """The share of runs in which some view up to each one showed the cue of the class."""
    pixels = record["methods"][method]["pixels"]
    return first_hits(np.array(pixels) >= CUE_PIXELS).mean(axis=0) if pixels else []


def _value(record: Record, method: str) -> dict[int, float]:
    steps = record["methods"][method].get("steps", []) if method in _BY_CROSS_ENTROPY else []
    return {view: step["value"] for view, step in enumerate(steps, start=2)}


def roughness(sampler: SurfaceSampler, inputs: StepInputs) -> float:
    """Grid cells that a sample's surface crosses on average, relative to the posterior mean's surface.

    The posterior mean is carved like the samples. For a posterior without closed forms it is the mean of the samples.
    The value is about 1 for samples as smooth as the mean, and rises if the spacing of the data exceeds the kernel's
    width. Near 5, an acquisition says little about the value of a view.
    """
    posterior, surfaces = inputs.posterior, inputs.surfaces
    assert posterior is not None
    assert surfaces is not None
    values, closed = np.asarray(surfaces.values), posterior.has_closed_forms
    mean = np.asarray(sampler.mean(inputs.observations, posterior)) if closed else values.mean(axis=0)
    samples = [crossed_cells(sample) for sample in values]
    return float(np.mean(samples)) / max(crossed_cells(mean), 1)


def crossed_cells(values: Float[np.ndarray, "g g g"]) -> int:
    """The number of cells whose eight corners do not share a sign."""
    inside = values < 0
    size = inside.shape[0] - 1
    corners = [inside[i : i + size, j : j + size, k : k + size] for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    return int(np.sum(np.any(corners, axis=0) & ~np.all(corners, axis=0)))


def rank_correlation(
    values: Float[AnyArray, " c"], true_values: Real[AnyArray, " c"], compared: Bool[np.ndarray, " c"]
) -> float | None:
    """Spearman's rank correlation of expected and true values; None if either is constant.

    - `compared`: which candidates to include.
    """
    a, b = np.asarray(values)[compared], np.asarray(true_values)[compared]
    return None if np.ptp(a) == 0 or np.ptp(b) == 0 else float(spearmanr(a, b).statistic)


MEASURES = (
    Measure("first", "First hit", _hit(first_hits), unit="%"),
    Measure("stable", "Stable hit", _hit(stable_hits), unit="%"),
    Measure("seen", "Cue seen", _seen, unit="%"),
    Measure("rank_correlation", "Rank correlation", lambda r, m: r["methods"][m]["rank_correlation"], digits=2),
    Measure("roughness", "Roughness", lambda r, m: r["methods"][m]["roughness"], digits=2, less=True),
    Measure("value", "Expected cross-entropy", _value, unit="nats"),
    SECONDS,
)
