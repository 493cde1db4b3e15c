"""Farthest point sampling, ball queries and interpolation against loops in NumPy."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnbv.checks import InputError
from jaxnbv.geometry.farthest_points import farthest_point_indices
from jaxnbv.networks.layers import FeaturePropagation, Linear, ball_query, interpolate

RNG = np.random.default_rng(0)


def lattice(side):
    return np.stack(np.meshgrid(*[np.arange(side, dtype=np.float32)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


def farthest_by_loop(points, mask, count):
    rows = np.flatnonzero(mask)
    chosen = [rows[0]]
    while len(chosen) < min(count, len(rows)):
        distance = ((points[rows, None] - points[chosen]) ** 2).sum(axis=-1).min(axis=1)
        distance[np.isin(rows, chosen)] = -1.0
        chosen.append(rows[np.argmax(distance)])
    return np.array(chosen + rows[:1].tolist() * (count - len(chosen)))


def ball_by_loop(centers, points, mask, radius, count):
    groups = []
    for center in centers:
        within = [j for j in np.flatnonzero(mask) if ((points[j] - center) ** 2).sum() <= radius**2][:count]
        within = within or [np.flatnonzero(mask)[0]]
        groups.append(within + within[:1] * (count - len(within)))
    return np.array(groups)


def some_mask(n, share):
    mask = RNG.random(n) < share
    mask[RNG.integers(n)] = True
    return mask


@pytest.mark.parametrize("n", [1, 31, 32, 33, 257])
@pytest.mark.parametrize("share", [1.0, 0.4])
def test_farthest_points_against_a_loop_and_masked_rows_may_hold_anything(x64, n, share):
    points, mask = RNG.normal(size=(n, 3)), some_mask(n, share)
    filled = np.where(mask[:, None], points, RNG.choice([np.nan, np.inf, 1e9], size=(n, 1)))
    count = 20
    found = farthest_point_indices(jnp.asarray(filled), jnp.asarray(mask), count)
    np.testing.assert_array_equal(found, farthest_by_loop(points, mask, count))
    assert len(set(np.asarray(found).tolist())) == min(count, mask.sum())


@pytest.mark.parametrize(("n", "count"), [(1, 1), (1, 4), (31, 8), (64, 40), (200, 64), (200, 256)])
@pytest.mark.parametrize("share", [1.0, 0.4])
def test_balls_against_a_loop(x64, n, count, share):
    points, mask = RNG.uniform(-1, 1, (n, 3)), some_mask(n, share)
    filled = np.where(mask[:, None], points, RNG.choice([np.nan, 0.0], size=(n, 1)))
    centers = np.concatenate([points[mask][:30], RNG.uniform(-1, 1, (10, 3))])
    for radius in (0.05, 0.5, 1.2, 9.0):
        found = ball_query(jnp.asarray(centers), jnp.asarray(filled), jnp.asarray(mask), radius, count)
        np.testing.assert_array_equal(found, ball_by_loop(centers, points, mask, radius, count))


def test_a_point_on_the_sphere_is_within():
    points = lattice(5)
    mask = np.ones(len(points), bool)
    for radius in (1.0, 2.0, 3.0):
        found = ball_query(jnp.asarray(points), jnp.asarray(points), jnp.asarray(mask), radius, 90)
        np.testing.assert_array_equal(found, ball_by_loop(points, points, mask, radius, 90))


def test_counts_below_one_are_refused():
    with pytest.raises(InputError, match="at least one"):
        farthest_point_indices(jnp.zeros((3, 3)), jnp.ones(3, bool), 0)
    with pytest.raises(InputError, match="at least one"):
        ball_query(jnp.zeros((3, 3)), jnp.zeros((3, 3)), jnp.ones(3, bool), 1.0, 0)


def interpolated_by_loop(points, coarse, features):
    result = np.zeros((len(points), features.shape[1]))
    for i, x in enumerate(points):
        squared = {j: ((x - y) ** 2).sum() for j, y in enumerate(coarse)}
        nearest = sorted(squared, key=squared.get)[:3]
        weights = [1 / (squared[j] + 1e-8) for j in nearest]
        for j, w in zip(nearest, weights, strict=True):
            result[i] += w / sum(weights) * features[j]
    return result


@pytest.mark.parametrize("m", [1, 2, 40])
def test_interpolation_against_a_loop(x64, m):
    points, coarse, features = RNG.normal(size=(30, 3)), RNG.normal(size=(m, 3)), RNG.normal(size=(m, 5))
    points[0] = coarse[0]
    np.testing.assert_allclose(
        jax.jit(interpolate)(points, coarse, features), interpolated_by_loop(points, coarse, features), atol=1e-12
    )


def test_gradients_are_bounded_however_close_the_coarse_points_are():
    """Single precision, where the weights span eight orders of magnitude; two coarse points coincide."""
    coarse = jnp.asarray([[0.0, 0, 0], [0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]])
    features = jnp.asarray([[1.0], [1.0], [2.0], [3.0]])
    both = jax.jit(jax.value_and_grad(lambda x, y: interpolate(x, y, features)[0, 0], argnums=(0, 1)))
    for distance in (0.0, 1e-5, 1e-4, 1e-2):
        value, gradient = both(jnp.asarray([[0.0, 0, distance]]), coarse)
        assert all(np.isfinite(g).all() and np.abs(g).max() < 100 for g in gradient)
        assert float(value) == pytest.approx(1.0, abs=0.02)


def test_a_propagation_is_a_perceptron_of_own_then_interpolated_features(x64):
    points, coarse = RNG.normal(size=(9, 3)), RNG.normal(size=(5, 3))
    own, features = RNG.normal(size=(9, 4)), RNG.normal(size=(5, 6))
    layers = [(RNG.normal(size=pair), RNG.normal(size=pair[1])) for pair in itertools.pairwise((10, 7, 3))]
    x = np.concatenate([own, interpolated_by_loop(points, coarse, features)], axis=1)
    for weight, bias in layers:
        x = np.maximum(x @ weight + bias, 0.0)
    propagation = FeaturePropagation(tuple(Linear(*map(jnp.asarray, layer)) for layer in layers))
    found = jax.jit(propagation.__call__)(points, coarse, own, features)
    assert (x > 0).any()
    np.testing.assert_allclose(found, x, atol=1e-11)
