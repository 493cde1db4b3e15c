"""Samples have the posterior's distribution: moments against weight space, and simulation-based calibration.

Seeds are fixed. Thresholds are 4.5 standard errors (7e-6) for a number, and a probability of 1e-4 for a chi-square
statistic.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from weight_space import WeightSpace

import jaxnbv as nbv

COMPUTES = True
SETTINGS = {"lengthscale": 0.15, "variance": 1.0, "noise": 0.3, "nu": 1.5, "truncation": 2}


def padded(points, normals, rows, capacity):
    """Data in the given rows, and garbage in the others."""
    rng = np.random.default_rng(99)
    arrays = rng.uniform(-1.5, 1.5, (2, *points.shape[:-2], capacity, 3))
    mask = np.zeros((*points.shape[:-2], capacity), bool)
    arrays[0][..., rows, :], arrays[1][..., rows, :], mask[..., rows] = points, normals, True
    return nbv.PointCloud(*(jnp.asarray(a, jnp.float32) for a in arrays), jnp.asarray(mask))


@pytest.mark.parametrize("noise", [0.3, 0.05])
def test_sample_mean_and_joint_covariance_equal_weight_space(noise):
    """12,000 samples at four data points and six others. After whitening by the exact moments, the 10 means and the 45
    correlations have standard error N^-1/2, and the 10 variances (2 / N)^1/2. The sums of squares are chi-square with
    10 and 55 degrees of freedom."""
    settings = SETTINGS | {"noise": noise}
    rng = np.random.default_rng(0)
    points, normals = rng.uniform(-0.6, 0.6, (12, 3)), rng.standard_normal((12, 3))
    x = np.concatenate([points[:4], rng.uniform(-1.5, 1.5, (6, 3))])
    mean, covariance = WeightSpace(**settings).posterior(points, normals, x)
    posterior = nbv.GeometricSPSR(**settings).condition(padded(points, normals, np.arange(2, 14), 16))
    draws = [np.asarray(posterior.sample(jax.random.key(seed), 4000)(x), np.float64) for seed in range(3)]
    white = np.linalg.solve(np.linalg.cholesky(covariance), (np.concatenate(draws) - mean).T)
    count = white.shape[1]
    means = white.mean(axis=1) * np.sqrt(count)
    moments = (white @ white.T / count - np.eye(10)) * np.sqrt(count)
    lower = np.concatenate([np.diag(moments) / np.sqrt(2), moments[np.tril_indices(10, -1)]])
    assert np.abs(means).max() < 4.5
    assert np.abs(lower).max() < 4.5
    assert scipy.stats.chi2.sf(np.sum(means**2), 10) > 1e-4
    assert scipy.stats.chi2.sf(np.sum(lower**2), 55) > 1e-4


@pytest.mark.slow
def test_posterior_is_calibrated():
    """Simulation-based calibration (Talts et al. 2018): 1,200 problems from the prior in weight space. Each has normals
    of f with noise at 10 random points, conditioned on in float32, and 31 samples. The rank of the true f among the
    samples is uniform on 0, ..., 31: chi-square over 8 bins of 150 expected, for f at two data points and at three
    others, two differences, and the minimum over all five points. The last depends on the joint distribution."""
    settings = SETTINGS | {"noise": 1.0}
    problems, count, samples, bins = 1200, 10, 31, 8
    oracle, rng = WeightSpace(**settings), np.random.default_rng(3)
    points = rng.uniform(-0.5, 0.5, (problems, count, 3))
    inner, outer = (rng.uniform(-extent, extent, (problems, 3)) for extent in (0.5, 1.57))
    x = np.stack([points[:, 0], points[:, 1], points[:, 2] + 0.2, inner, outer], axis=1)
    truth, normals = np.zeros((problems, 5)), np.zeros((problems, count, 3))
    for i in range(problems):
        weights = rng.standard_normal((3, oracle.num_weights))
        truth[i] = np.einsum("dnk,dk->n", oracle.function_features(x[i]), weights)
        normals[i] = oracle.normal_features(points[i]) @ weights.T
    normals += oracle.noise * rng.standard_normal(normals.shape)
    model = nbv.GeometricSPSR(**settings)

    def sample(problem):
        cloud, x, key = problem
        return model.condition(cloud).sample(key, samples)(x)

    clouds = padded(points, normals, np.array([0, 1, 2, 3, 5, 6, 8, 9, 10, 11]), 12)
    keys = jax.random.split(jax.random.key(0), problems)
    inputs = (clouds, jnp.asarray(x, jnp.float32), keys)
    draws = jax.jit(lambda inputs: jax.lax.map(sample, inputs, batch_size=16))(inputs)

    def quantities(f):
        differences = [f[..., 0] - f[..., 1], f[..., 0] - f[..., 2]]
        return np.concatenate([f, np.stack([*differences, f.min(axis=-1)], axis=-1)], axis=-1)

    ranks = np.sum(quantities(np.asarray(draws)) < quantities(truth)[:, None], axis=1)
    for quantity in range(ranks.shape[1]):
        observed = np.bincount(ranks[:, quantity] * bins // (samples + 1), minlength=bins)
        assert scipy.stats.chisquare(observed).pvalue > 1e-4, (quantity, observed)
