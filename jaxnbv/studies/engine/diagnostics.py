"""Whether a step's imagined surfaces carry a signal."""

import numpy as np
from jaxtyping import Bool, Float, Real
from scipy.stats import spearmanr

from jaxnbv.checks import AnyArray
from jaxnbv.imagination import Imagination
from jaxnbv.scanning import Evidence, GridSurface
from jaxnbv.surfaces import SurfacePosterior


def roughness(
    imagination: Imagination, evidence: Evidence, posterior: SurfacePosterior, surfaces: GridSurface
) -> float:
    """Cells of the grid that a sample's surface crosses, mean over samples, per cell that the mean's surface crosses,
    carved as the samples are. Of a posterior without closed forms the mean is that of these samples.

    About 1 for samples as smooth as the mean. It rises when the spacing of the data exceeds the kernel's width; near 5
    an acquisition says little about the value of a view.
    """
    values = np.asarray(surfaces.values)
    mean = np.asarray(imagination.mean(evidence, posterior)) if posterior.has_closed_forms else values.mean(axis=0)
    samples = [crossed_cells(one) for one in values]
    return float(np.mean(samples)) / max(crossed_cells(mean), 1)


def crossed_cells(values: Float[np.ndarray, "g g g"]) -> int:
    """Cells whose eight corners do not share a sign."""
    inside = values < 0
    size = inside.shape[0] - 1
    corners = [inside[i : i + size, j : j + size, k : k + size] for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    return int(np.sum(np.any(corners, axis=0) & ~np.all(corners, axis=0)))


def rank_correlation(
    values: Float[AnyArray, " c"], true_values: Real[AnyArray, " c"], compared: Bool[np.ndarray, " c"]
) -> float | None:
    """Spearman's, between the expected and the true values of the candidates compared; None where either does not
    vary."""
    a, b = np.asarray(values)[compared], np.asarray(true_values)[compared]
    return None if np.ptp(a) == 0 or np.ptp(b) == 0 else float(spearmanr(a, b).statistic)
