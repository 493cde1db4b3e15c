"""Distances to the nearest point, against a k-d tree, brute force, bounds and finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

import jaxnbv as nbv
from jaxnbv.geometry.neighbours import NearestPoints, nearest_squared_distance, spacing


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


def exact(x, cloud):
    return nearest_squared_distance(x, cloud)


def looked_up(x, cloud):
    return NearestPoints.of(cloud, 24).squared_distance(x)


def weighted(distance, x, points, mask):
    return jnp.sum(jnp.arange(1.0, len(x) + 1) * distance(x, cloud_of(points, mask)))


@pytest.mark.parametrize("argument", [0, 1])
@pytest.mark.parametrize("distance", [exact, looked_up])
def test_gradient_against_finite_differences(x64, distance, argument):
    arguments = list(problem())
    gradient = np.asarray(jax.grad(weighted, argnums=1 + argument)(distance, *arguments))
    value = jax.jit(weighted, static_argnums=0)
    expected = np.zeros_like(gradient)
    for i in np.ndindex(gradient.shape):
        moved = [list(arguments), list(arguments)]
        for sign, there in zip((1, -1), moved, strict=True):
            there[argument] = arguments[argument].at[i].add(sign * 1e-5)
        expected[i] = (value(distance, *moved[0]) - value(distance, *moved[1])) / 2e-5
    assert np.abs(expected).max() > 1
    np.testing.assert_allclose(gradient, expected, atol=1e-7)
    if argument == 1:
        assert not gradient[~np.asarray(arguments[2])].any()


@pytest.mark.parametrize("distance", [exact, looked_up])
def test_second_derivatives(x64, distance):
    """|x - y|^2 has the Hessian 2 I in x."""
    x, points, mask = problem()

    def f(x):
        return distance(x[None], cloud_of(points, mask))[0]

    for hessian in (jax.hessian(f), jax.jacrev(jax.jacrev(f))):
        np.testing.assert_allclose(hessian(x[0]), 2 * np.eye(3), atol=1e-12)


@pytest.mark.parametrize("count", [2, 30, 3000])
def test_a_looked_up_distance_is_too_large_by_at_most_the_diagonal_of_a_cell(count):
    """From a corner c of the cell of x to its nearest point y: |x - y| <= |x - c| + |c - y| <= 2 |x - c| + d(x)."""
    rng = np.random.default_rng(count)
    points, mask = rng.uniform(-1.0, 1.0, (2 * count, 3)).astype(np.float32), np.arange(2 * count) % 2 == 0
    points[~mask] = 0.0
    nearest = NearestPoints.of(cloud_of(points, mask), 32)
    x = rng.uniform(-3.0, 3.0, (2000, 3)).astype(np.float32)
    low, spacing = np.asarray(nearest.low, np.float64), float(nearest.spacing)
    corners = low + spacing * np.clip(np.round((x - low) / spacing), 0, 31)
    true = cKDTree(points[mask]).query(x)[0]
    distances = np.asarray(nearest(jnp.asarray(x)))
    assert (distances >= true - 1e-5).all()
    assert (distances <= true + 2 * np.linalg.norm(x - corners, axis=1) + 1e-5).all()
    # So far apart, each point is the nearest of some node.
    if count <= 30:
        inside = np.all((x >= low) & (x <= low + 31 * spacing), axis=1)
        assert np.mean(distances[inside] <= true[inside] + 1e-5) > 0.99


def test_clouds_of_no_point_and_of_one():
    points = np.full((20, 3), 0.5, np.float32)
    x = jnp.asarray(np.random.default_rng(4).normal(size=(9, 3)), jnp.float32)
    empty = NearestPoints.of(cloud_of(points, np.zeros(20, bool)))
    assert np.isposinf(empty.squared_distance(x)).all()
    single = NearestPoints.of(cloud_of(points, np.arange(20) == 7))
    np.testing.assert_allclose(single.squared_distance(x), ((np.asarray(x) - 0.5) ** 2).sum(1), rtol=1e-5)


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
