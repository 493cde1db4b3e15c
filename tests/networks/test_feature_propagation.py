"""Interpolation against a loop in NumPy and finite differences."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnbv.networks.layers import FeaturePropagation, Linear, interpolate

RNG = np.random.default_rng(0)
jitted = jax.jit(interpolate)


def by_loop(points, coarse, features):
    result = np.zeros((len(points), features.shape[1]))
    for i, x in enumerate(points):
        squared = {j: ((x - y) ** 2).sum() for j, y in enumerate(coarse)}
        nearest = sorted(squared, key=squared.get)[:3]
        weights = [1 / (squared[j] + 1e-8) for j in nearest]
        for j, w in zip(nearest, weights, strict=True):
            result[i] += w / sum(weights) * features[j]
    return result


@pytest.mark.parametrize("m", [1, 2, 40])
def test_against_a_loop(x64, m):
    points, coarse, features = RNG.normal(size=(30, 3)), RNG.normal(size=(m, 3)), RNG.normal(size=(m, 5))
    points[0] = coarse[0]
    np.testing.assert_allclose(jitted(points, coarse, features), by_loop(points, coarse, features), atol=1e-12)


def test_gradients_against_central_differences(x64):
    arrays = [RNG.normal(size=shape) for shape in ((6, 3), (7, 3), (7, 2))]

    @jax.jit
    def value(arrays):
        return jnp.sum(jnp.arange(1.0, 13.0).reshape(6, 2) * interpolate(*arrays))

    gradients = jax.jit(jax.grad(value))(arrays)
    for which, array in enumerate(arrays):
        expected = np.zeros(array.shape)
        for i in np.ndindex(array.shape):
            ends = []
            for sign in (1, -1):
                moved = [other.copy() for other in arrays]
                moved[which][i] += sign * 1e-6
                ends.append(float(value(moved)))
            expected[i] = (ends[0] - ends[1]) / 2e-6
        assert np.abs(expected).max() > 0.1
        np.testing.assert_allclose(gradients[which], expected, atol=1e-6)


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
    x = np.concatenate([own, by_loop(points, coarse, features)], axis=1)
    for weight, bias in layers:
        x = np.maximum(x @ weight + bias, 0.0)
    propagation = FeaturePropagation(tuple(Linear(*map(jnp.asarray, layer)) for layer in layers))
    found = jax.jit(propagation.__call__)(points, coarse, own, features)
    assert (x > 0).any()
    np.testing.assert_allclose(found, x, atol=1e-11)
