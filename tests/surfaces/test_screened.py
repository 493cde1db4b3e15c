"""Values with normals, against one regression on both in weight space; the effect of each kind of value."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2
from weight_space import JointWeightSpace, WeightSpace, ball, cloud

import jaxnbv as nbv
from jaxnbv.surfaces import ValueRows

RNG = np.random.default_rng(0)
POINTS, NORMALS = RNG.uniform(-1.0, 1.0, (20, 3)), RNG.standard_normal((20, 3))
QUERIES = np.concatenate([POINTS[:3], RNG.uniform(-1.4, 1.4, (9, 3))])
LENGTHSCALES, VARIANCES = (0.1, 0.3), (0.8, 0.6)
AT, VALUES, NOISE = RNG.uniform(-1.2, 1.2, (13, 3)), RNG.standard_normal(13), RNG.uniform(0.1, 1.0, 13)
AT[-1], VALUES[-1], NOISE[-1] = 2.4, np.nan, -1.0


class Given(nbv.surfaces.ValueSource):
    """Values at points of the test's choice. The last row is not filled, and may hold anything."""

    points: jax.Array
    values: jax.Array
    noise: jax.Array

    def rows(self, observations):
        return ValueRows(self.points, self.values, self.noise, jnp.arange(len(self.values)) < len(self.values) - 1)


def model_of(**rows):
    rows = {"points": AT, "values": VALUES, "noise": NOISE} | rows
    base = nbv.GeometricSPSR(LENGTHSCALES, VARIANCES, truncation=3, noise=0.2)
    return nbv.ScreenedSPSR(base, (Given(**{name: jnp.asarray(a) for name, a in rows.items()}),), level_deviation=0.7)


def test_moments_and_samples_are_those_of_one_regression_of_normals_and_values(x64):
    """400 samples at twelve points. After whitening by the exact moments, the sample mean is chi-square, and the
    covariance is the identity within 4.5 standard errors."""
    posterior = model_of().condition(cloud(POINTS, NORMALS, 27))
    scales = [WeightSpace(ell, variance, 0.2, 1.5, 3) for ell, variance in zip(LENGTHSCALES, VARIANCES, strict=True)]
    h = float(posterior.value_unit)
    data = POINTS, NORMALS, 0.2, AT[:-1], h * VALUES[:-1], abs(h) * NOISE[:-1]
    mean, covariance = JointWeightSpace(scales, 0.7).posterior(data, QUERIES)
    np.testing.assert_allclose(posterior.mean(QUERIES), mean, atol=1e-9 * np.abs(mean).max())
    np.testing.assert_allclose(posterior.variance(QUERIES), np.diag(covariance), atol=1e-9 * covariance.max())
    values = posterior.sample(jax.random.key(1), 400)(QUERIES)
    z = np.linalg.solve(np.linalg.cholesky(covariance), (values - mean).T)
    assert 400 * np.sum(z.mean(axis=1) ** 2) < chi2.ppf(0.9999, 12)
    np.testing.assert_allclose(z @ z.T / 400, np.eye(12), atol=4.5 * np.sqrt(2 / 400))


@pytest.mark.parametrize(
    ("where", "number", "message"),
    [
        ("points", -2.4, r"coordinate of 2\.4, outside the scene.*mask the row, or bring the point there"),
        ("points", np.nan, "points that are not finite: mask"),
        ("values", np.inf, "values that are not finite: mask"),
        ("noise", -0.5, r"noise of -0\.5; it must not be negative"),
    ],
)
def test_rows_of_a_users_source_are_checked(x64, where, number, message):
    """If they cannot be checked, a point outside gives NaN."""
    rows = {"points": AT, "values": VALUES, "noise": NOISE}[where].copy()
    rows[0] = number
    model, data = model_of(**{where: rows}), cloud(POINTS, NORMALS, 27)
    with pytest.raises(ValueError, match=message):
        model.condition(data)
    if where == "points":
        assert np.isnan(traced_mean(model, data)).all()


@eqx.filter_jit
def traced_mean(model, cloud):
    return model.condition(cloud).mean(QUERIES)


@pytest.fixture(scope="module")
def scanned_ball():
    """A ball, nodes of a grid half a unit beside it, and the posteriors without and with these nodes seen to be empty.

    The corners of the grid lie outside the scene, and were seen too.
    """
    data, grid = ball(np.random.default_rng(0), 80), nbv.Grid(20)
    axis = np.asarray(grid.axis)
    nodes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    is_beside = np.linalg.norm(nodes - [0.0, 1.2, 0.0], axis=-1) < 0.4
    beyond = (np.abs(nodes) > 1.6).all(axis=-1)
    assert is_beside.sum() >= 40
    assert beyond.sum() == 8
    boundary = nbv.surfaces.OutsideBoundary(num_points=60, noise=0.02)
    sources = boundary, nbv.surfaces.OnSurface(30, noise=0.02), nbv.surfaces.EmptySpace(30)
    model = nbv.ScreenedSPSR(nbv.GeometricSPSR((0.03, 0.1), (0.2, 0.4), truncation=8), sources, offset=0.2)
    nothing = nbv.Observations.start(data, 1, grid)
    with_empty = eqx.tree_at(lambda e: e.empty_nodes, nothing, jnp.asarray(is_beside | beyond))
    return nodes[is_beside], (nothing, with_empty), [model.condition(seen) for seen in (nothing, with_empty)]


def test_values_are_reached_in_units_of_half_the_rise_of_the_mean_across_the_data(scanned_ball):
    _, (observations, _), (posterior, _) = scanned_ball
    mean, (points, normals) = posterior.base.mean, observations.cloud.to_numpy()
    rise = np.asarray(mean(points + 0.2 * normals) - mean(points - 0.2 * normals))
    h, rows = float(posterior.value_unit), posterior.rows
    # 256 rows are drawn from 80, so that each occurs three or four times.
    assert 0.5 * np.quantile(rise, 0.4) < h < 0.5 * np.quantile(rise, 0.6)
    values, radius = np.asarray(posterior.mean(rows.points)), np.linalg.norm(rows.points, axis=1)
    np.testing.assert_allclose(values[:90], h * np.asarray(rows.values)[:90], atol=0.1 * h)
    np.testing.assert_allclose(radius[60:90], 0.7, rtol=1e-5)
    np.testing.assert_allclose(np.abs(rows.points[:60]).max(axis=1), 1.25, rtol=1e-5)
    np.testing.assert_array_equal(rows.mask, np.arange(120) < 90)


def test_empty_space_and_its_surroundings_are_likelier_outside(scanned_ball):
    """Empty nodes, places a tenth of a unit from them, and places far away."""
    beside, observations, posteriors = scanned_ball
    places = np.stack([beside, beside + np.array([0.0, 0.0, 0.1]), beside * np.array([1.0, -1.0, 1.0])])
    inside = [np.mean(one.probability_inside(places.reshape(-1, 3)).reshape(3, -1), axis=1) for one in posteriors]
    assert inside[1][0] < 0.3 * inside[0][0]
    assert inside[1][1] < 0.5 * inside[0][1]
    assert abs(inside[1][2] - inside[0][2]) < 0.1
    rows = nbv.surfaces.EmptySpace(30).rows(observations[1])
    assert np.asarray(rows.mask).all()
    assert len(np.unique(rows.points, axis=0)) == 30
    assert {tuple(p) for p in np.asarray(rows.points)} <= {tuple(p) for p in np.float32(beside)}
    for without in (observations[0], nbv.as_observations(observations[0].cloud)):
        assert not np.asarray(nbv.surfaces.EmptySpace(30).rows(without).mask).any()


def test_rows_beyond_the_data_are_not_filled():
    data = ball(RNG, 20)
    rows = nbv.surfaces.OnSurface(30).rows(nbv.as_observations(data))
    assert np.asarray(rows.mask).sum() == 20
    assert len(np.unique(np.asarray(rows.points)[:20], axis=0)) == 20


def test_the_posterior_is_differentiable_in_the_data(x64):
    data, model = (
        ball(RNG, 20),
        nbv.ScreenedSPSR(nbv.GeometricSPSR(0.1, truncation=3), (nbv.surfaces.OutsideBoundary(num_points=20),)),
    )

    def mean(shift):
        moved = eqx.tree_at(lambda c: c.points, data, data.points + shift)
        return jnp.sum(model.condition(moved).mean(QUERIES))

    both = jax.jit(jax.value_and_grad(mean))
    np.testing.assert_allclose(both(0.0)[1], (both(1e-5)[0] - both(-1e-5)[0]) / 2e-5, rtol=1e-6)
