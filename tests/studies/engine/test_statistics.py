"""The bootstrap against its closed form for shares, and against the coverage it promises."""

import numpy as np
import pytest
from scipy.stats import binom

from jaxnbv.checks import InputError
from jaxnbv.studies.engine.statistics import bootstrap_mean, paired_difference


@pytest.mark.parametrize("level", [0.5, 0.9, 0.99])
def test_the_interval_of_a_share_is_that_of_a_binomial(level):
    # A resample of 0s and 1s has a binomial count of 1s.
    values = np.repeat([0.0, 1.0], [35, 65])
    estimate = bootstrap_mean(values, np.random.default_rng(0), level, resamples=200_000)
    tail = 0.5 * (1 - level)
    assert estimate.mean == pytest.approx(0.65)
    # A percentile that falls on a jump of the distribution may go either way.
    assert abs(100 * estimate.low - binom.ppf(tail, 100, 0.65)) <= 1.001
    assert abs(100 * estimate.high - binom.ppf(1 - tail, 100, 0.65)) <= 1.001
    assert estimate.low < 0.65 < estimate.high


def test_the_interval_of_normal_values_is_that_of_the_normal():
    values = np.random.default_rng(1).normal(3.0, 2.0, 2000)
    estimate = bootstrap_mean(values, np.random.default_rng(0))
    half_width = 1.6449 * values.std() / np.sqrt(2000)
    np.testing.assert_allclose([estimate.low, estimate.high], values.mean() + np.array([-1, 1]) * half_width, atol=5e-3)


def test_intervals_hold_the_truth_as_often_as_they_say():
    rng = np.random.default_rng(2)
    hits = 0
    for _ in range(400):
        estimate = bootstrap_mean(rng.normal(0.3, 1.0, 60), rng, resamples=400)
        hits += bool(estimate.low <= 0.3 <= estimate.high)
    # 0.90 less what the percentile bootstrap loses at 60 scenes, within three standard errors of 0.015.
    assert 0.84 <= hits / 400 <= 0.94


def test_scenes_are_resampled_as_a_whole():
    rng = np.random.default_rng(3)
    first = rng.uniform(size=(40, 3))
    together = bootstrap_mean(np.stack([first, 1.0 - first], axis=1), np.random.default_rng(0))
    assert together.low.shape == (2, 3)
    # One's high end is the other's low end only if both saw the same resamples.
    np.testing.assert_allclose(together.low[0], 1.0 - together.high[1], atol=1e-12)
    again = bootstrap_mean(np.stack([first, 1.0 - first], axis=1), np.random.default_rng(0))
    np.testing.assert_array_equal(together.low, again.low)


def test_pairing_takes_the_scenes_difficulty_out():
    rng = np.random.default_rng(4)
    difficulty = rng.normal(0.0, 10.0, 50)
    difference = paired_difference(difficulty + 1.0 + 0.1 * rng.normal(size=50), difficulty, rng)
    assert difference.excludes_zero
    assert 0.9 < difference.low < difference.mean < difference.high < 1.1


def test_an_interval_that_touches_zero_does_not_exclude_it():
    generator = np.random.default_rng(0)
    same = paired_difference(np.ones((5, 2)), np.ones((5, 2)), generator)
    np.testing.assert_array_equal(same.excludes_zero, [False, False])
    assert not paired_difference(np.array([1.0, 0, 0, 0]), np.zeros(4), generator).excludes_zero
    assert paired_difference(np.zeros(4), np.ones(4), generator).excludes_zero


def test_one_scene_has_no_width_and_none_has_no_mean():
    estimate = bootstrap_mean(np.array([[0.25, 0.75]]), np.random.default_rng(0))
    np.testing.assert_array_equal(estimate.low, [0.25, 0.75])
    np.testing.assert_array_equal(estimate.high, [0.25, 0.75])
    with pytest.raises(InputError, match="no scenes"):
        bootstrap_mean(np.zeros((0, 2)), np.random.default_rng(0))
    with pytest.raises(InputError, match=r"level is 1\.0"):
        bootstrap_mean(np.zeros(2), np.random.default_rng(0), level=1.0)
