"""The non-uniform transform against direct evaluation, its transpose, direct sums and finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnbv.surfaces.trigonometric import NonuniformTransform, TrigonometricFields

RNG = np.random.default_rng(0)


def points_with_borders(count):
    points = RNG.uniform(-np.pi / 2, np.pi / 2, (count, 3))
    points[:8] = np.pi / 2 * np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    points[8] = [np.pi / 2, 0.0, -np.pi / 2]
    return points


def relative(actual, expected):
    expected = np.asarray(expected, np.float64)
    return np.linalg.norm(np.asarray(actual) - expected) / np.linalg.norm(expected)


@pytest.mark.parametrize("truncation", [1, 4, 20])
@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float32, 1e-5), (np.float64, 1e-10)])
def test_transform_and_adjoint_equal_direct_sums(truncation, dtype, tolerance):
    """White coefficients, so that the highest frequencies count as much as the lowest; corners of the scene and points
    on the transform's own nodes included. Relative errors, in the norm and, ten times as large, at the worst point."""
    modes = 2 * truncation + 1
    points = points_with_borders(60).astype(dtype)
    points[10:20] = -np.pi / 2 + np.pi / (2 * truncation) * RNG.integers(0, modes, (10, 3))
    points = np.clip(points, -dtype(np.pi / 2), dtype(np.pi / 2))
    coefficients, values = RNG.standard_normal((2, modes, modes, modes)), RNG.standard_normal((60, 2))
    factors = []
    for x in points.T.astype(np.float64):
        angle = x[:, None] * np.arange(-truncation, truncation + 1)
        factors.append(np.where(np.arange(modes) >= truncation, np.cos(angle), np.sin(-angle)))
    expected = np.einsum("kabc,na,nb,nc->nk", coefficients, *factors, optimize=True)
    spread = np.einsum("nk,na,nb,nc->kabc", values, *factors, optimize=True)
    with jax.enable_x64(dtype is np.float64):

        @jax.jit
        def both(points, coefficients, values):
            transform = NonuniformTransform(points, truncation)
            return transform.evaluate(coefficients), transform.adjoint(values)

        results = both(*(jnp.asarray(a, dtype) for a in (points, coefficients, values)))
    actual, adjoint = (np.asarray(result) for result in results)
    assert actual.dtype == adjoint.dtype == dtype
    assert relative(actual, expected) < tolerance
    assert np.abs(actual - expected).max() < 10 * tolerance * expected.std()
    assert relative(adjoint, spread) < tolerance
    left, right = np.vdot(actual, values), np.vdot(coefficients, adjoint)
    scale = np.linalg.norm(actual) * np.linalg.norm(values)
    assert abs(left - right) < (1e-13 if dtype == np.float64 else 1e-6) * scale


def test_gradients_on_nodes_and_borders_are_those_of_the_function():
    """A point on a node has a window that ends exactly on its last node, where the square root starts."""
    nodes = -np.pi / 2 + np.pi / 12 * np.arange(13)
    points = jnp.asarray(np.stack([nodes, nodes[::-1], nodes], axis=1), jnp.float32)
    coefficients = jnp.asarray(RNG.standard_normal((1, 13, 13, 13)), jnp.float32)
    gradient = jax.jit(jax.grad(lambda x: jnp.sum(NonuniformTransform(x, 6).evaluate(coefficients))))(points)
    exact = jax.jit(jax.grad(lambda x: jnp.sum(TrigonometricFields(coefficients)(x))))(points)
    np.testing.assert_allclose(gradient, exact, atol=1e-3 * float(jnp.abs(exact).max()))
