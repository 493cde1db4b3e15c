"""Moments and the probability of being inside: closed forms against samples, and samples drawn once against sums."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from jaxtyping import Array, Float
from weight_space import WeightSpace

from jaxnbv.errors import InputError
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.surfaces import (
    Fields,
    GeometricSPSR,
    OnSurface,
    OutsideBoundary,
    SampledPosterior,
    ScreenedSPSR,
    SurfacePosterior,
)

RNG = np.random.default_rng(0)
X = RNG.uniform(-1.4, 1.4, (40, 3)).astype(np.float32)
BASE = GeometricSPSR(0.05, truncation=6, noise=0.1)
MODELS = {"geometric": BASE, "screened": ScreenedSPSR(BASE, (OutsideBoundary(num_points=40), OnSurface(20)))}


def sphere(count=40):
    points = RNG.standard_normal((count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return PointCloud.from_arrays(0.7 * points, points, capacity=count + 8)


def test_the_probability_of_being_inside_is_the_share_of_the_samples_that_are():
    """1,500 samples at 40 points, within 4.5 standard errors and the rounding of a share."""
    posterior, count = MODELS["screened"].condition(sphere()), 1500
    probability = np.asarray(posterior.probability_inside(X), np.float64)
    share = np.mean(posterior.sample(jax.random.key(1), count)(X) < posterior.level, axis=0)
    error = np.sqrt(probability * (1 - probability) / count)
    np.testing.assert_array_less(np.abs(share - probability), 4.5 * error + 1 / count)
    assert probability.min() < 0.2 < 0.8 < probability.max()


def test_the_probability_of_being_inside_is_that_of_weight_space(x64):
    settings = {"lengthscale": 0.1, "variance": 0.8, "noise": 0.2, "nu": 1.5, "truncation": 3}
    points, normals = RNG.uniform(-1.0, 1.0, (20, 3)), RNG.standard_normal((20, 3))
    posterior = GeometricSPSR(**settings).condition(
        PointCloud(jnp.asarray(points), jnp.asarray(normals), jnp.ones(20, bool))
    )
    x = np.asarray(X, np.float64)
    mean, covariance = WeightSpace(**settings).posterior(points, normals, np.concatenate([x, points]))
    level = mean[len(x) :].mean()
    expected = scipy.stats.norm.cdf((level - mean[: len(x)]) / np.sqrt(np.diag(covariance)[: len(x)]))
    np.testing.assert_allclose(posterior.probability_inside(x), expected, rtol=1e-8)
    with pytest.raises(InputError, match=r"coordinate of 3\.2, outside"):
        posterior.probability_inside(np.full((1, 3), 3.2))


@pytest.mark.parametrize("name", MODELS)
def test_what_has_closed_forms_is_drawn_as_itself(name):
    posterior = MODELS[name].condition(sphere())
    assert posterior.drawn() is posterior


class Shifted(Fields):
    """a_s x + b_s."""

    slopes: Float[Array, " s"]
    offsets: Float[Array, " s"]

    def __call__(self, x):
        return self.slopes[:, None] * jnp.asarray(x)[:, 0] + self.offsets[:, None]


class Calls:
    """Numbers of samples that were asked for. No list, of which a compiled program would take a copy."""

    def __init__(self):
        self.numbers = []


class Lines(SurfacePosterior):
    """Lines of random slope and offset, counting how often they are drawn."""

    level: Float[Array, ""]
    calls: Calls = eqx.field(static=True)

    def sample(self, key, num_samples):
        self.calls.numbers.append(num_samples)
        slopes, offsets = jax.random.normal(key, (2, num_samples))
        return Shifted(1.0 + slopes, offsets)


def lines():
    return Lines(jnp.asarray(0.4), Calls())


def test_moments_of_samples_drawn_once_are_those_of_the_samples():
    posterior = lines()
    drawn = posterior.drawn(50)
    assert isinstance(drawn, SampledPosterior)
    assert drawn.drawn() is drawn
    values = np.asarray(drawn.fields(X), np.float64)
    assert values.shape == (50, 40)
    np.testing.assert_allclose(drawn.mean(X), values.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(drawn.variance(X), values.var(axis=0, ddof=1), rtol=1e-5)
    np.testing.assert_allclose(drawn.probability_inside(X), (values < np.float32(0.4)).mean(axis=0), rtol=1e-6)
    axis = np.linspace(-1.0, 1.2, 5, dtype=np.float32)
    grid = np.broadcast_to(np.asarray(drawn.mean(np.stack([axis, axis, axis], axis=1)))[:, None, None], (5, 5, 5))
    np.testing.assert_allclose(drawn.mean_on_grid(axis), grid, atol=1e-6)
    assert drawn.level == posterior.level
    assert posterior.calls.numbers == [50]


def test_defaults_are_estimated_from_one_draw_of_64_the_same_at_every_call():
    posterior, axis = lines(), np.linspace(-1.0, 1.2, 5, dtype=np.float32)
    drawn = posterior.drawn()
    for name in ("mean", "variance", "probability_inside"):
        of_one, at_once = (np.asarray(getattr(p, name)(X)) for p in (posterior, drawn))
        np.testing.assert_array_equal(of_one, at_once, err_msg=name)
    before = len(posterior.calls.numbers)
    grid = np.asarray(posterior.mean_on_grid(axis))
    assert posterior.calls.numbers[before:] == [64]
    np.testing.assert_allclose(grid, drawn.mean_on_grid(axis), atol=1e-6)
    assert set(posterior.calls.numbers) == {64}


def test_moments_of_samples_are_within_monte_carlo_error_of_the_exact_ones():
    """2,000 Gaussian samples: 1 + a has mean x and variance 1 + x^2; errors of the three within 4.5 standard ones."""
    drawn, x, count = lines().drawn(2000), X[:, 0].astype(np.float64), 2000
    variance = 1.0 + x**2
    inside = scipy.stats.norm.cdf((0.4 - x) / np.sqrt(variance))
    np.testing.assert_array_less(np.abs(drawn.mean(X) - x), 4.5 * np.sqrt(variance / count))
    np.testing.assert_allclose(drawn.variance(X), variance, rtol=4.5 * np.sqrt(2 / count))
    error = np.sqrt(inside * (1 - inside) / count)
    np.testing.assert_array_less(np.abs(drawn.probability_inside(X) - inside), 4.5 * error)


def test_samples_of_what_was_drawn_are_new_ones():
    posterior = lines()
    drawn, key = posterior.drawn(), jax.random.key(5)
    values = np.asarray(drawn.sample(key, 70)(X))
    np.testing.assert_array_equal(values, posterior.sample(key, 70)(X))
    kept = np.asarray(drawn.fields(X))
    assert np.abs(values[:, None] - kept).max(axis=-1).min() > 1e-4


class LinesOfKnownMean(Lines):
    """They know their mean, x + 0.5 say, and nothing else."""

    def mean(self, x):
        return jnp.asarray(x)[:, 0] + 0.5


def test_a_mean_of_its_own_is_that_of_the_grid_and_the_rest_is_estimated():
    posterior, axis = LinesOfKnownMean(jnp.asarray(0.4), Calls()), np.linspace(-1.0, 1.2, 5, dtype=np.float32)
    assert posterior.drawn(8) is posterior
    expected = np.broadcast_to((axis + 0.5)[:, None, None], (5, 5, 5))
    np.testing.assert_allclose(posterior.mean_on_grid(axis), expected, atol=1e-6)
    assert posterior.calls.numbers == []
    np.testing.assert_array_equal(posterior.variance(X), lines().variance(X))
