"""Nearest squared distances against a k-d tree, brute force and finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

import jaxnbv as nbv
from jaxnbv.geometry.neighbours import nearest_squared_distance, spacing


def cloud_of(points, mask=None):
    points = jnp.asarray(points)
    mask = jnp.ones(len(points), bool) if mask is None else jnp.asarray(mask)
    return nbv.PointCloud(points, jnp.zeros_like(points).at[:, 0].set(1.0), mask)


def brute_force(x, points):
    x, points = np.asarray(x, dtype=np.float64), np.asarray(points, dtype=np.float64)
    return np.sum((x[:, None] - points[None]) ** 2, axis=-1).min(axis=1)


@pytest.mark.parametrize("count", [1, 15, 16, 17, 100])
@pytest.mark.parametrize("share", [1.0, 0.4])
def test_against_kdtree_with_masked_rows_anywhere(count, share):
    rng = np.random.default_rng(count)
    x, points = rng.uniform(-1.5, 1.5, (50, 3)), rng.uniform(-1.5, 1.5, (count, 3))
    mask = rng.random(count) < share
    mask[rng.integers(count)] = True
    points = np.where(mask[:, None] | (rng.random(count) < 0.5)[:, None], points, 0.0)
    distance, _ = cKDTree(points[mask]).query(x)
    distances = nearest_squared_distance(jnp.asarray(x, jnp.float32), cloud_of(points.astype(np.float32), mask))
    np.testing.assert_allclose(distances, distance**2, atol=3e-6)


def test_points_of_the_cloud_are_at_distance_zero_and_never_below():
    points = np.random.default_rng(2).uniform(-1.5, 1.5, (64, 3)).astype(np.float32)
    distances = np.asarray(nearest_squared_distance(jnp.asarray(points), cloud_of(points)))
    assert (distances >= 0).all()
    np.testing.assert_allclose(distances, 0.0, atol=3e-6)


def test_an_empty_cloud_is_infinitely_far():
    distances = nearest_squared_distance(jnp.ones((4, 3)), cloud_of(np.zeros((20, 3), np.float32), np.zeros(20, bool)))
    assert np.isposinf(distances).all()


def problem():
    rng = np.random.default_rng(3)
    x, points = rng.normal(size=(9, 3)), rng.normal(size=(21, 3))
    return jnp.asarray(x), jnp.asarray(points), jnp.asarray(rng.random(21) < 0.7)


def weighted(x, points, mask):
    return jnp.sum(jnp.arange(1.0, len(x) + 1) * nearest_squared_distance(x, cloud_of(points, mask)))


@pytest.mark.parametrize("argument", [0, 1])
def test_gradient_against_finite_differences(x64, argument):
    arguments = list(problem())
    gradient = np.asarray(jax.grad(weighted, argnums=argument)(*arguments))
    value = jax.jit(weighted)
    expected = np.zeros_like(gradient)
    for i in np.ndindex(gradient.shape):
        moved = [list(arguments), list(arguments)]
        for sign, there in zip((1, -1), moved, strict=True):
            there[argument] = arguments[argument].at[i].add(sign * 1e-5)
        expected[i] = (value(*moved[0]) - value(*moved[1])) / 2e-5
    assert np.abs(expected).max() > 1
    np.testing.assert_allclose(gradient, expected, atol=1e-7)
    if argument == 1:
        assert not gradient[~np.asarray(arguments[2])].any()


def test_second_derivatives(x64):
    """|x - y|^2 has the Hessian 2 I in x."""
    x, points, mask = problem()

    def f(x):
        return nearest_squared_distance(x[None], cloud_of(points, mask))[0]

    for hessian in (jax.hessian(f), jax.jacrev(jax.jacrev(f))):
        np.testing.assert_allclose(hessian(x[0]), 2 * np.eye(3), atol=1e-12)


@pytest.mark.parametrize("count", [2, 3, 200, 700])
def test_the_spacing_is_the_median_distance_between_neighbours(count):
    """For many points the median of some is within a tenth."""
    points = np.random.default_rng(3).normal(size=(count, 3))
    rows = np.random.default_rng(4).permutation(1000)[:count]
    padded, mask = np.zeros((1000, 3), np.float32), np.zeros(1000, bool)
    padded[rows], mask[rows] = points, True
    cloud = nbv.PointCloud(jnp.asarray(padded), jnp.asarray(padded), jnp.asarray(mask))
    expected = np.median(cKDTree(points).query(points, k=2)[0][:, 1])
    assert float(spacing(cloud)) == pytest.approx(expected, rel=0.1)


def test_fewer_than_two_points_have_no_spacing():
    for count in (0, 1):
        cloud = nbv.PointCloud(jnp.ones((5, 3)), jnp.ones((5, 3)), jnp.arange(5) < count)
        assert float(spacing(cloud)) == 0.0
