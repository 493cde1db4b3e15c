"""How sure a mean over scenes is, by resampling the scenes (Efron's percentile bootstrap)."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxnbv.checks import require

LEVEL = 0.90


class Estimate(NamedTuple):
    """A mean over scenes and the ends of its bootstrap interval, element by element."""

    mean: Float[np.ndarray, "*rest"]
    low: Float[np.ndarray, "*rest"]
    high: Float[np.ndarray, "*rest"]

    @property
    def excludes_zero(self) -> Bool[np.ndarray, "*rest"]:
        """Whether all of the interval lies on one side of zero."""
        return np.asarray((self.low > 0) | (self.high < 0))


def bootstrap_mean(
    values: Float[np.ndarray, "scenes *rest"],
    generator: np.random.Generator,
    level: float = LEVEL,
    resamples: int = 10_000,
) -> Estimate:
    """The mean over scenes with its percentile interval: as many scenes are drawn with replacement, `resamples` times.

    What lies along the other axes is resampled together, scene by scene. One scene alone has an interval without width.

    **Raises:** `ValueError` if there are no scenes, or the level is not within (0, 1).
    """
    require(len(values) > 0, "a mean over no scenes is not defined: give at least one scene")
    require(0 < level < 1, f"the interval's level is {level}; it must lie within (0, 1), such as 0.9")
    scenes, rest = len(values), values.shape[1:]
    times_drawn = generator.multinomial(scenes, np.full(scenes, 1.0 / scenes), size=resamples)
    means = (times_drawn / scenes) @ values.reshape(scenes, -1)
    tail = 0.5 * (1.0 - level)
    low, high = np.quantile(means, [tail, 1.0 - tail], axis=0)
    return Estimate(values.mean(axis=0), low.reshape(rest), high.reshape(rest))


def paired_difference(
    first: Float[np.ndarray, "scenes *rest"],
    second: Float[np.ndarray, "scenes *rest"],
    generator: np.random.Generator,
    level: float = LEVEL,
    resamples: int = 10_000,
) -> Estimate:
    """The mean of first - second over the same scenes in the same order, with its percentile bootstrap interval.

    **Raises:** as `bootstrap_mean`.
    """
    return bootstrap_mean(first - second, generator, level, resamples)
