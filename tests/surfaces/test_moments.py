"""Moments and the probability of being inside: closed forms against weight space, and estimates against sums over
samples."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from jaxtyping import Array, Float
from weight_space import WeightSpace, cloud

import jaxnbv as nbv

RNG = np.random.default_rng(0)
X = RNG.uniform(-1.4, 1.4, (40, 3)).astype(np.float32)
AXIS = np.linspace(-1.0, 1.2, 5, dtype=np.float32)


def test_the_probability_of_being_inside_is_that_of_weight_space(x64):
    settings = {"lengthscale": 0.1, "variance": 0.8, "noise": 0.2, "nu": 1.5, "truncation": 3}
    points, normals = RNG.uniform(-1.0, 1.0, (20, 3)), RNG.standard_normal((20, 3))
    posterior = nbv.GeometricSPSR(**settings).condition(cloud(points, normals))
    assert posterior.has_closed_forms
    x = np.asarray(X, np.float64)
    mean, covariance = WeightSpace(**settings).posterior(points, normals, np.concatenate([x, points]))
    level = mean[len(x) :].mean()
    expected = scipy.stats.norm.cdf((level - mean[: len(x)]) / np.sqrt(np.diag(covariance)[: len(x)]))
    np.testing.assert_allclose(posterior.probability_inside(x), expected, rtol=1e-8)
    with pytest.raises(nbv.InputError, match=r"coordinate of 3\.2, outside"):
        posterior.probability_inside(np.full((1, 3), 3.2))


class Shifted(nbv.surfaces.Fields):
    """The functions a_s x + b_s."""

    slopes: Float[Array, " s"]
    offsets: Float[Array, " s"]

    def __call__(self, x):
        return self.slopes[:, None] * jnp.asarray(x)[:, 0] + self.offsets[:, None]


class Lines(nbv.surfaces.SurfacePosterior):
    """Lines of random slope and offset."""

    level: Float[Array, ""] = eqx.field(default_factory=lambda: jnp.asarray(0.4))

    def sample(self, key, num_samples):
        slopes, offsets = jax.random.normal(key, (2, num_samples))
        return Shifted(1.0 + slopes, offsets)


def test_moments_without_closed_forms_are_those_of_64_samples_under_a_fixed_key():
    posterior = Lines()
    values = np.asarray(posterior.sample(jax.random.key(0), 64)(X), np.float64)
    np.testing.assert_allclose(posterior.mean(X), values.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(posterior.variance(X), values.var(axis=0, ddof=1), rtol=1e-5)
    np.testing.assert_allclose(posterior.probability_inside(X), (values < np.float32(0.4)).mean(axis=0), rtol=1e-6)
    on_axis = np.asarray(posterior.mean(np.stack([AXIS, AXIS, AXIS], axis=1)))
    grid = np.broadcast_to(on_axis[:, None, None], (5, 5, 5))
    np.testing.assert_allclose(posterior.mean_on_grid(AXIS), grid, atol=1e-6)


class LinesOfKnownMean(Lines):
    """Lines whose posterior knows its mean, x + 0.5, and nothing else."""

    def mean(self, x):
        return jnp.asarray(x)[:, 0] + 0.5


def test_a_mean_of_its_own_is_that_of_the_grid_and_the_rest_is_estimated():
    posterior = LinesOfKnownMean()
    expected = np.broadcast_to((AXIS + 0.5)[:, None, None], (5, 5, 5))
    np.testing.assert_allclose(posterior.mean_on_grid(AXIS), expected, atol=1e-6)
    np.testing.assert_array_equal(posterior.variance(X), Lines().variance(X))
