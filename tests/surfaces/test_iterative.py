"""Conjugate gradients against the factorisation, and what they refuse."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from weight_space import WeightSpace

import jaxnbv as nbv
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.surfaces import GeometricSPSR, spsr
from jaxnbv.surfaces.iterative import IterativePosterior

SETTINGS = {"lengthscale": 0.1, "variance": 0.8, "noise": 0.2, "nu": 1.5, "truncation": 4}
RNG = np.random.default_rng(3)
POINTS, NORMALS, QUERIES = RNG.uniform(-1.3, 1.3, (30, 3)), RNG.standard_normal((30, 3)), RNG.uniform(-1.5, 1.5, (9, 3))


def cloud(count: int = 30, capacity: int = 37) -> PointCloud:
    """Rows that are not filled hold what is not a number."""
    rows = (np.pad(a[:count], ((0, capacity - count), (0, 0)), constant_values=np.nan) for a in (POINTS, NORMALS))
    return PointCloud(*map(jnp.asarray, rows), jnp.arange(capacity) < count)


def test_mean_level_and_variance_equal_those_in_weight_space(x64):
    posterior = spsr._iterative(GeometricSPSR(**SETTINGS), cloud())
    mean, covariance = WeightSpace(**SETTINGS).posterior(POINTS, NORMALS, QUERIES)
    at_data, _ = WeightSpace(**SETTINGS).posterior(POINTS, NORMALS, POINTS)
    np.testing.assert_allclose(posterior.mean(QUERIES), mean, atol=1e-8 * np.abs(mean).max())
    np.testing.assert_allclose(posterior.variance(QUERIES), np.diag(covariance), atol=1e-8 * covariance.max())
    np.testing.assert_allclose(posterior.level, at_data.mean(), atol=1e-8 * np.abs(mean).max())


def test_samples_are_those_of_the_factorisation_under_the_same_key(x64):
    model, key = GeometricSPSR(**SETTINGS), jax.random.key(0)
    found, expected = spsr._iterative(model, cloud()), model.factorised(cloud())
    np.testing.assert_allclose(found.sample(key, 3)(QUERIES), expected.sample(key, 3)(QUERIES), atol=1e-8)
    means = expected.sample(jax.random.key(1), 2)
    np.testing.assert_allclose(
        found.sample_about(means, key)(QUERIES), expected.sample_about(means, key)(QUERIES), atol=1e-8
    )


def test_float32_is_exact_to_a_ten_thousandth():
    """A sphere of 2,000 points at the default noise, against float64."""
    points = RNG.standard_normal((2000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    settings = {"lengthscale": 0.03, "truncation": 12}
    single = PointCloud.from_arrays(points, points)
    queries = 1.3 * points[::20]
    found = spsr._iterative(GeometricSPSR(**settings), single).mean(queries)
    with jax.enable_x64(True):
        expected = GeometricSPSR(**settings).factorised(PointCloud.from_arrays(points, points)).mean(queries)
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())


def test_what_does_not_converge_is_refused(monkeypatch):
    """Two steps for thirty points; of a capacity of its own, so that it is compiled so."""
    monkeypatch.setattr("jaxnbv.surfaces.spsr.MOST_FACTORISED", 29)
    monkeypatch.setattr("jaxnbv.surfaces.iterative._MOST_PRODUCTS", 2)
    with pytest.raises(ValueError, match=r"singular in float32: raise the noise"):
        GeometricSPSR(0.1, 0.8, 4, noise=0.01).condition(cloud(capacity=31))


def test_the_capacity_tells_which_is_taken(monkeypatch):
    monkeypatch.setattr("jaxnbv.surfaces.spsr.MOST_FACTORISED", 38)
    model = GeometricSPSR(**SETTINGS)
    assert not isinstance(model.condition(cloud(capacity=38)), IterativePosterior)
    assert isinstance(model.condition(cloud(capacity=39)), IterativePosterior)
    for refusing in (model.factorised, nbv.ScreenedSPSR(model).condition):
        with pytest.raises(ValueError, match=r"room for 39 points.*38 at most: lower the planner's capacity"):
            refusing(cloud(capacity=39))
