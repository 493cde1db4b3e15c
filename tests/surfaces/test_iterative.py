"""Conjugate gradients against the factorisation, and refused methods."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from weight_space import WeightSpace

import jaxnbv as nbv
from jaxnbv.surfaces import solver
from jaxnbv.surfaces.pathwise import MeansAtData

SETTINGS = {"lengthscale": 0.1, "variance": 0.8, "noise": 0.2, "nu": 1.5, "truncation": 4}
RNG = np.random.default_rng(3)
POINTS, NORMALS, QUERIES = RNG.uniform(-1.3, 1.3, (30, 3)), RNG.standard_normal((30, 3)), RNG.uniform(-1.5, 1.5, (9, 3))


def cloud(capacity: int) -> nbv.PointCloud:
    """Rows that are not filled hold NaN."""
    rows = (np.pad(a, ((0, capacity - 30), (0, 0)), constant_values=np.nan) for a in (POINTS, NORMALS))
    return nbv.PointCloud(*map(jnp.asarray, rows), jnp.arange(capacity) < 30)


@pytest.fixture
def few(monkeypatch):
    """Capacities above 36 are not factorised. No other file has these capacities, because compiled programs stay."""
    monkeypatch.setattr(solver, "MAX_DENSE_CAPACITY", 36)


def test_every_method_equals_the_factorisation_and_weight_space(x64, few):
    model, key = nbv.GeometricSPSR(**SETTINGS), jax.random.key(0)
    posterior, factorised = model.condition(cloud(47)), model.condition(cloud(36))
    assert isinstance(posterior.solver, solver.ConjugateGradientSolver)
    assert isinstance(factorised.solver, solver.DenseSolver)
    mean, covariance = WeightSpace(**SETTINGS).posterior(POINTS, NORMALS, QUERIES)
    np.testing.assert_allclose(posterior.mean(QUERIES), mean, atol=1e-8 * np.abs(mean).max())
    np.testing.assert_allclose(posterior.variance(QUERIES), np.diag(covariance), atol=1e-8 * covariance.max())
    np.testing.assert_allclose(posterior.level, factorised.level, atol=1e-8)
    # The same rows in both, since capacities differ.
    rows = posterior.cloud.normals[None]
    solve = eqx.filter_jit(lambda posterior, rows: posterior.solver.solve(rows))
    np.testing.assert_allclose(solve(posterior, rows)[:, :36], solve(factorised, rows[:, :36]), atol=1e-8)
    draws = eqx.filter_jit(posterior.prior_draws)(key, 2)
    same = draws._replace(noisy_normals=draws.noisy_normals[:, :36])
    none = MeansAtData(jnp.zeros(()), jnp.zeros(()))
    conditioned = eqx.filter_jit(lambda posterior, draws: posterior.condition_draws(draws, none))
    np.testing.assert_allclose(conditioned(posterior, draws), conditioned(factorised, same), atol=1e-8)


@pytest.mark.parametrize("capacity", [35, 46], ids=("factorised", "by conjugate gradients"))
def test_a_traced_point_outside_the_scene_gives_no_number(few, capacity):
    """A known value outside the scene is refused."""
    outside = eqx.tree_at(lambda c: c.points, cloud(capacity), cloud(capacity).points.at[3, 1].set(2.2))
    model = nbv.GeometricSPSR(**SETTINGS)
    with pytest.raises(ValueError, match=r"coordinate of 2\.2, outside the scene's cube"):
        model.condition(outside)
    traced = eqx.filter_jit(lambda cloud: model.condition(cloud).mean(QUERIES.astype(np.float32)))
    assert np.isnan(traced(outside)).all()


def test_float32_is_exact_to_a_ten_thousandth(monkeypatch):
    """500 points on a sphere, as dense as 2,000 on one of radius 1, at the default noise, against float64."""
    points = RNG.standard_normal((500, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    queries = 0.65 * points[::5]
    model = nbv.GeometricSPSR(lengthscale=0.03, truncation=12)
    with jax.enable_x64(True):
        expected = model.condition(nbv.PointCloud.from_arrays(0.5 * points, points)).mean(queries)
    monkeypatch.setattr(solver, "MAX_DENSE_CAPACITY", 499)
    mean = model.condition(nbv.PointCloud.from_arrays(0.5 * points, points)).mean(queries)
    np.testing.assert_allclose(mean, expected, atol=1e-4 * np.abs(expected).max())


def test_what_does_not_converge_is_refused(few, monkeypatch):
    """Two steps for thirty points, with a capacity that no other test compiles."""
    monkeypatch.setattr(solver, "_MAX_PRODUCTS", 2)
    with pytest.raises(ValueError, match=r"singular in float32: raise the noise"):
        nbv.GeometricSPSR(0.1, 0.8, 4, noise=0.01).condition(cloud(41))


def test_what_needs_the_factor_is_refused(few, monkeypatch):
    model = nbv.GeometricSPSR(**SETTINGS)
    with pytest.raises(ValueError, match=r"need a factorisation, which is done for at most 36 points"):
        eqx.filter_eval_shape(lambda cloud: model.condition(cloud).log_marginal_likelihood(), cloud(42))
    with pytest.raises(ValueError, match=r"need a factorisation, which is done for at most 36 points"):
        eqx.filter_eval_shape(lambda cloud: model.condition(cloud).covariance(QUERIES, QUERIES), cloud(42))
    monkeypatch.setattr("jaxnbv.surfaces.screened.MAX_DENSE_CAPACITY", 36)
    with pytest.raises(ValueError, match=r"room for 39 points.*36 at most: lower the planner's capacity"):
        nbv.ScreenedSPSR(model).condition(cloud(39))
