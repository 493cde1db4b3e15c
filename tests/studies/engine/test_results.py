"""Bootstrap intervals against their closed form for shares, and against their nominal coverage."""

import numpy as np
from scipy.stats import binom

from jaxnbv.studies.engine.results import LEVEL, interval


def test_the_interval_of_a_share_is_that_of_a_binomial():
    # A resample of 0s and 1s has a binomial number of 1s.
    low, high = interval(np.repeat([0.0, 1.0], [35, 65])[:, None])
    tail = 0.5 * (1 - LEVEL)
    # A percentile at a jump of the distribution may be on either side.
    assert abs(100 * low[0] - binom.ppf(tail, 100, 0.65)) <= 1.001
    assert abs(100 * high[0] - binom.ppf(1 - tail, 100, 0.65)) <= 1.001


def test_intervals_hold_the_truth_as_often_as_they_say():
    low, high = interval(np.random.default_rng(2).normal(0.3, 1.0, (60, 200)))
    # 0.90 minus the loss of the percentile bootstrap for 60 scenes, within three standard errors of 0.021.
    assert 0.82 <= np.mean((low <= 0.3) & (high >= 0.3)) <= 0.96


def test_scenes_are_resampled_as_a_whole():
    first = np.random.default_rng(3).uniform(size=(40, 3))
    low, high = interval(np.concatenate([first, 1.0 - first], axis=1))
    # The high end of one is the low end of the other only if both have the same resamples.
    np.testing.assert_allclose(low[:3], 1.0 - high[3:], atol=1e-12)
    np.testing.assert_array_equal(interval(first), interval(first))


def test_one_scene_has_no_width():
    np.testing.assert_array_equal(interval(np.array([[0.25, 0.75]])), [[0.25, 0.75]] * 2)
