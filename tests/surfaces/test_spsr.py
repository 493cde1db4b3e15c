"""The posterior against Bayesian linear regression in weight space, the reference, and finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from weight_space import WeightSpace, cloud

import jaxnbv as nbv
from jaxnbv.surfaces.covariance import function_normal_covariance, function_variance, normal_covariance
from jaxnbv.surfaces.factor import CholeskyFactor

RNG = np.random.default_rng(0)
POINTS, NORMALS = RNG.uniform(-1.3, 1.3, (30, 3)), RNG.standard_normal((30, 3))
QUERIES = np.concatenate([POINTS[:4], RNG.uniform(-1.5, 1.5, (12, 3))])
SETTINGS = {"lengthscale": 0.1, "variance": 0.8, "noise": 0.2, "nu": 1.5, "truncation": 4}
SINGLE = cloud(POINTS, NORMALS, 37, jnp.float32)


@pytest.mark.parametrize(
    "changes",
    [{}, {"nu": 0.5}, {"nu": 2.5, "lengthscale": 0.3}, {"noise": 0.01}],
    ids=str,
)
def test_posterior_equals_regression_in_weight_space(x64, changes):
    settings = SETTINGS | changes
    oracle, posterior = WeightSpace(**settings), nbv.GeometricSPSR(**settings).condition(cloud(POINTS, NORMALS, 37))
    mean, covariance = oracle.posterior(POINTS, NORMALS, QUERIES)
    np.testing.assert_allclose(posterior.mean(QUERIES), mean, atol=1e-9 * np.abs(mean).max())
    np.testing.assert_allclose(posterior.covariance(QUERIES, QUERIES), covariance, atol=1e-9 * covariance.max())
    np.testing.assert_allclose(posterior.covariance(QUERIES[:5], QUERIES), covariance[:5], atol=1e-9 * covariance.max())
    np.testing.assert_allclose(posterior.variance(QUERIES), np.diag(covariance), atol=1e-9 * covariance.max())
    at_data, _ = oracle.posterior(POINTS, NORMALS, POINTS)
    np.testing.assert_allclose(posterior.level, at_data.mean(), atol=1e-9 * np.abs(mean).max())
    likelihood = oracle.log_marginal_likelihood(POINTS, NORMALS)
    np.testing.assert_allclose(posterior.log_marginal_likelihood(), likelihood, rtol=1e-9)


def test_the_order_and_the_values_of_masked_rows_change_nothing(x64):
    model = nbv.GeometricSPSR(**SETTINGS)
    rows = RNG.permutation(37)[:30]
    points, normals = 100.0 * RNG.standard_normal((2, 37, 3))
    points[rows], normals[rows] = POINTS, NORMALS
    scattered = nbv.PointCloud(jnp.asarray(points), jnp.asarray(normals), jnp.zeros(37, bool).at[rows].set(True))
    results = []
    for data in (cloud(POINTS, NORMALS, 37), scattered):
        posterior = model.condition(data)
        likelihood, level = posterior.log_marginal_likelihood(), posterior.level
        results.append((posterior.mean(QUERIES), posterior.covariance(QUERIES, QUERIES), likelihood, level))
    for first, second in zip(*results, strict=True):
        np.testing.assert_allclose(first, second, rtol=1e-9, atol=1e-11)


def test_float32_posterior_is_near_that_of_weight_space():
    """At little noise. Errors are relative to the largest value of each."""
    settings = SETTINGS | {"noise": 0.03}
    oracle, posterior = WeightSpace(**settings), nbv.GeometricSPSR(**settings).condition(SINGLE)
    mean, covariance = oracle.posterior(POINTS, NORMALS, QUERIES)
    likelihood = oracle.log_marginal_likelihood(POINTS, NORMALS)
    results = posterior.mean(QUERIES), posterior.variance(QUERIES), posterior.log_marginal_likelihood()
    for actual, value in zip(results, (mean, np.diag(covariance), likelihood), strict=True):
        np.testing.assert_allclose(actual, value, atol=3e-4 * np.abs(value).max())


def reference_problem(shared, truncation):
    data = np.load(shared / "reference" / "geospsr_spot.npz")
    noise = float(data["noise_variance"]) ** 0.5
    model = nbv.GeometricSPSR(float(data["lengthscale"]), float(data["variance_1d"]), truncation, noise)
    return data, model, jnp.asarray(data["points"]), jnp.asarray(data["queries"])


def relative(actual, expected):
    return np.linalg.norm(np.asarray(actual) - expected) / np.linalg.norm(expected)


def test_reference_formula_from_these_covariances(x64, shared):
    """Mean and variance by the reference's formula: k(X, X) over all frequencies (here up to 400) in A, with the
    cross-covariance and the prior variance of f truncated at L = 20. Equal to 1e-4."""
    data, model, x, queries = reference_problem(shared, 20)
    untruncated = nbv.GeometricSPSR(model.lengthscale, model.variance, 400, model.noise)
    kernel = np.asarray(normal_covariance(x, x, untruncated.spectrum))
    np.testing.assert_allclose(kernel[:16, :16], data["kernel_16x16"], atol=1e-4 * kernel.max())
    kernel = kernel + float(data["noise_variance"]) * np.eye(len(kernel))
    cross = np.asarray(function_normal_covariance(queries, x, model.spectrum))
    mean = np.einsum("dqn,nd->q", cross, np.linalg.solve(kernel, data["normals"]))
    np.testing.assert_allclose(mean, data["mean"], atol=1e-4 * np.abs(data["mean"]).max())
    cross = cross[:, : len(data["variance"])]
    explained = sum(np.einsum("qn,nq->q", c, np.linalg.solve(kernel, c.T)) for c in cross)
    variance = float(function_variance(model.spectrum)) - explained
    np.testing.assert_allclose(variance, data["variance"], rtol=1e-4)


def central_difference(function, value, direction, step=1e-5):
    return (function(value + step * direction) - function(value - step * direction)) / (2 * step)


PARAMETERS = ("points", "normals", "queries", "lengthscale", "variance", "noise")


def test_posterior_is_differentiable_in_data_queries_and_hyperparameters(x64):
    """A scalar of mean, variance and level, and the log marginal likelihood, against differences in weight space."""
    keep = {"nu": 1.5, "truncation": 3}
    values = dict(zip(PARAMETERS, (POINTS, NORMALS, QUERIES, 0.1, 0.8, 0.2), strict=True))
    functional = np.random.default_rng(1).standard_normal((2, len(QUERIES)))

    def package(parameters):
        p = parameters
        model = nbv.GeometricSPSR(p["lengthscale"], p["variance"], noise=p["noise"], **keep)
        posterior = model.condition(nbv.PointCloud(p["points"], p["normals"], jnp.ones(30, bool)))
        x = p["queries"]
        return jnp.stack(
            [
                functional[0] @ posterior.mean(x),
                functional[1] @ posterior.variance(x),
                posterior.level,
                posterior.log_marginal_likelihood(),
            ]
        )

    def oracle(p):
        regression = WeightSpace(p["lengthscale"], p["variance"], p["noise"], **keep)
        mean, covariance = regression.posterior(p["points"], p["normals"], p["queries"])
        level = regression.posterior(p["points"], p["normals"], p["points"])[0].mean()
        likelihood = regression.log_marginal_likelihood(p["points"], p["normals"])
        return np.array([functional[0] @ mean, functional[1] @ np.diag(covariance), level, likelihood])

    gradient = jax.jit(jax.jacrev(package))({name: jnp.asarray(value) for name, value in values.items()})
    rng = np.random.default_rng(2)
    for name in PARAMETERS:
        direction = rng.standard_normal(np.shape(values[name])) if np.ndim(values[name]) else 1.0
        expected = central_difference(lambda value: oracle(values | {name: value}), values[name], direction)  # noqa: B023
        actual = np.sum(np.asarray(gradient[name]) * direction, axis=tuple(range(1, 1 + np.ndim(direction))))
        np.testing.assert_allclose(actual, expected, rtol=1e-5, atol=1e-8, err_msg=name)
        assert np.abs(expected).max() > 1e-3


def test_a_truncation_that_keeps_little_variance_is_reported():
    with pytest.warns(UserWarning, match=r"truncation=10 keeps \d+% of the prior's variance"):
        nbv.GeometricSPSR(truncation=10)


@pytest.mark.parametrize("nu", [0.5, 1.5, 2.5])
def test_kept_variance_is_the_prior_variance_of_weight_space(nu):
    variance = nbv.GeometricSPSR(lengthscale=0.1, variance=0.8, truncation=4, nu=nu).kept_variance
    oracle = WeightSpace(lengthscale=0.1, variance=0.8, truncation=4, nu=nu)
    np.testing.assert_allclose(variance, (oracle.amplitude**2).sum() / 0.8**3 + oracle.constant**2 / 0.8**3, rtol=1e-5)


def test_a_matrix_that_is_not_positive_definite_has_a_factor_that_is_not_finite():
    assert not np.isfinite(CholeskyFactor.of(jnp.asarray(np.diag([1.0, -1.0, 2.0]))).upper).all()


def test_bad_clouds_are_refused():
    model = nbv.GeometricSPSR(lengthscale=0.1, truncation=3)
    good = cloud(POINTS, NORMALS)
    for points, normals, mask, message in (
        (good.points, good.normals, jnp.zeros(30, bool), "the cloud is empty: .* Point the camera at"),
        (good.points.at[3, 1].set(jnp.nan), good.normals, good.mask, "not finite"),
        (good.points, good.normals.at[0, 0].set(jnp.inf), good.mask, "not finite"),
        (good.points.at[5, 2].set(-1.6), good.normals, good.mask, r"coordinate of 1\.6, outside the scene's cube"),
        (good.points, good.normals.at[4].set(jnp.array([0.0, 100.0, 0.0])), good.mask, "1 normals .* longer than 10"),
    ):
        with pytest.raises(ValueError, match=message):
            model.condition(nbv.PointCloud(points, normals, mask))


def test_points_where_functions_only_repeat_are_refused():
    posterior = nbv.GeometricSPSR(**SETTINGS).condition(SINGLE)
    fields, far, near = posterior.sample(jax.random.key(0), 2), QUERIES.copy(), QUERIES.copy()
    far[3, 2], near[3, 2] = -3.2, np.float32(np.pi)
    functions = (posterior.mean, posterior.variance, fields, lambda x: posterior.covariance(x, QUERIES))
    for ask in functions:
        with pytest.raises(ValueError, match=r"coordinate of 3\.2, outside \[-pi, pi\]\^3.*Frame\.to_scene"):
            ask(far)
        assert np.isfinite(ask(near)).all()


@pytest.mark.parametrize("count", [1, 10, 11, 29, 40])
def test_a_large_capacity_gives_what_its_filled_rows_give(x64, monkeypatch, count):
    """Above the capacity limit only the leading share of the rows is processed: a quarter of 40 is 10."""
    monkeypatch.setattr("jaxnbv.surfaces.solver._SMALL_CAPACITY", 30)
    rng = np.random.default_rng(count)
    points, normals = rng.uniform(-1.3, 1.3, (count, 3)), rng.standard_normal((count, 3))
    oracle, posterior = WeightSpace(**SETTINGS), nbv.GeometricSPSR(**SETTINGS).condition(cloud(points, normals, 40))
    mean, covariance = oracle.posterior(points, normals, QUERIES)
    np.testing.assert_allclose(posterior.mean(QUERIES), mean, atol=1e-9 * np.abs(mean).max())
    np.testing.assert_allclose(posterior.covariance(QUERIES, QUERIES), covariance, atol=1e-9 * covariance.max())
