"""Values with normals, against one regression on both in weight space; the effect of each kind of value."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from weight_space import JointWeightSpace, WeightSpace, ball, cloud

import jaxnbv as nbv
from jaxnbv.surfaces import ValueRows

RNG = np.random.default_rng(0)
POINTS, NORMALS = RNG.uniform(-1.0, 1.0, (20, 3)), RNG.standard_normal((20, 3))
QUERIES = np.concatenate([POINTS[:3], RNG.uniform(-1.4, 1.4, (9, 3))])
SCALES = {"lengthscale": (0.1, 0.3), "variance": (0.8, 0.6)}
ONE = {"lengthscale": 0.1, "variance": 0.8}


class Given(nbv.surfaces.ValueSource):
    """Values at points of the test's choice. The last row is not filled, and may hold anything."""

    points: jax.Array
    values: jax.Array
    noise: jax.Array

    def rows(self, observations):
        return ValueRows(self.points, self.values, self.noise, jnp.arange(len(self.values)) < len(self.values) - 1)


def problem(hyperparameters, capacity=27):
    at = RNG.uniform(-1.2, 1.2, (13, 3))
    values, noise = RNG.standard_normal(13), RNG.uniform(0.1, 1.0, 13)
    at[-1], values[-1], noise[-1] = 2.4, np.nan, -1.0
    source = Given(*(jnp.asarray(a) for a in (at, values, noise)))
    base = nbv.GeometricSPSR(truncation=3, noise=0.2, **hyperparameters)
    posterior = nbv.ScreenedSPSR(base, (source,), level_deviation=0.7).condition(cloud(POINTS, NORMALS, capacity))
    ells, variances = (np.atleast_1d(hyperparameters[name]) for name in ("lengthscale", "variance"))
    scales = [WeightSpace(ell, variance, 0.2, 1.5, 3) for ell, variance in zip(ells, variances, strict=True)]
    h = float(posterior.value_unit)
    data = POINTS, NORMALS, 0.2, at[:-1], h * values[:-1], abs(h) * noise[:-1]
    return posterior, JointWeightSpace(scales, 0.7).posterior(data, QUERIES)


@pytest.mark.parametrize("hyperparameters", [ONE, SCALES], ids=("one scale", "two scales"))
def test_posterior_equals_one_regression_of_normals_and_values(x64, hyperparameters):
    posterior, (mean, covariance) = problem(hyperparameters)
    np.testing.assert_allclose(posterior.mean(QUERIES), mean, atol=1e-9 * np.abs(mean).max())
    np.testing.assert_allclose(posterior.variance(QUERIES), np.diag(covariance), atol=1e-9 * covariance.max())


@pytest.mark.parametrize(
    ("where", "number", "message"),
    [
        ("points", -2.4, r"coordinate of 2\.4, outside the scene.*mask the row, or bring the point there"),
        ("points", np.nan, "points that are not finite: mask"),
        ("values", np.inf, "values that are not finite: mask"),
        ("noise", -0.5, r"noise of -0\.5; it must not be negative"),
    ],
)
def test_rows_of_a_users_source_are_checked(where, number, message):
    """The first of two filled rows. If it cannot be checked, a point outside gives NaN."""
    rows = {
        "points": np.full((3, 3), 0.9, np.float32),
        "values": np.ones(3, np.float32),
        "noise": np.ones(3, np.float32),
    }
    rows[where][0] = number
    model = nbv.ScreenedSPSR(nbv.GeometricSPSR(0.1, truncation=3), (Given(*map(jnp.asarray, rows.values())),))
    with pytest.raises(ValueError, match=message):
        model.condition(cloud(POINTS, NORMALS, 27))
    if where == "points":
        traced = eqx.filter_jit(lambda model, cloud: model.condition(cloud).mean(QUERIES.astype(np.float32)))
        assert np.isnan(traced(model, cloud(POINTS, NORMALS, 27))).all()


def test_the_unit_of_values_is_half_the_rise_of_the_mean_across_the_data():
    data, base = ball(RNG, 60), nbv.GeometricSPSR(0.03, truncation=8)
    posterior = nbv.ScreenedSPSR(base, offset=0.2).condition(data)
    mean, (points, normals) = base.condition(data).mean, data.to_numpy()
    rise = np.asarray(mean(points + 0.2 * normals) - mean(points - 0.2 * normals))
    # 256 rows are drawn from 60, so that each occurs four or five times.
    assert 0.5 * np.quantile(rise, 0.4) < float(posterior.value_unit) < 0.5 * np.quantile(rise, 0.6)


def test_values_are_reached_where_they_are_said_to_be():
    data = ball(RNG, 80)
    posterior = nbv.ScreenedSPSR(
        nbv.GeometricSPSR((0.03, 0.1), (0.2, 0.4), truncation=8),
        (nbv.surfaces.OutsideBoundary(num_points=60, noise=0.02), nbv.surfaces.OnSurface(30, noise=0.02)),
    ).condition(data)
    h, rows = float(posterior.value_unit), posterior.rows
    assert h > 0
    np.testing.assert_allclose(np.asarray(posterior.mean(rows.points)), h * np.asarray(rows.values), atol=0.1 * h)
    radius = np.linalg.norm(rows.points, axis=1)
    np.testing.assert_allclose(radius[60:], 0.7, rtol=1e-5)
    np.testing.assert_allclose(np.abs(rows.points[:60]).max(axis=1), 1.25, rtol=1e-5)


def test_empty_space_and_its_surroundings_are_likelier_outside():
    """Nodes half a unit to the side of a scanned ball, places a tenth of a unit from them, and places far away. The
    corners of the grid lie outside the scene, and were seen too."""
    data, grid = ball(RNG, 80), nbv.Grid(20)
    axis = np.asarray(grid.axis)
    nodes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    is_beside = np.linalg.norm(nodes - [0.0, 1.2, 0.0], axis=-1) < 0.4
    beyond = (np.abs(nodes) > 1.6).all(axis=-1)
    assert is_beside.sum() >= 40
    assert beyond.sum() == 8
    model = nbv.ScreenedSPSR(
        nbv.GeometricSPSR((0.03, 0.1), (0.2, 0.4), truncation=8),
        (nbv.surfaces.OutsideBoundary(num_points=60), nbv.surfaces.EmptySpace(30)),
    )
    nothing = nbv.Observations.start(data, 1, grid)
    with_empty = eqx.tree_at(lambda e: e.empty_nodes, nothing, jnp.asarray(is_beside | beyond))
    without, with_bank = (model.condition(observations) for observations in (nothing, with_empty))
    beside = nodes[is_beside]
    near, far = beside + np.array([0.0, 0.0, 0.1]), beside * np.array([1.0, -1.0, 1.0])

    def inside(posterior, x):
        return float((posterior.sample(jax.random.key(0), 64)(x) < 0).mean())

    assert inside(with_bank, beside) < 0.3 * inside(without, beside)
    assert inside(with_bank, near) < 0.5 * inside(without, near)
    assert abs(inside(with_bank, far) - inside(without, far)) < 0.1
    rows = nbv.surfaces.EmptySpace(30).rows(with_empty)
    assert np.asarray(rows.mask).all()
    assert len(np.unique(np.asarray(rows.points), axis=0)) == 30
    assert {tuple(p) for p in np.asarray(rows.points)} <= {tuple(p) for p in np.float32(beside)}
    for observations in (nothing, nbv.as_observations(data)):
        assert not np.asarray(nbv.surfaces.EmptySpace(30).rows(observations).mask).any()


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
