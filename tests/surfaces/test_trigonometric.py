"""Band-limited fields: values, grids and derivatives against plain sums, automatic and finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnbv.surfaces.base import Fields
from jaxnbv.surfaces.trigonometric import TrigonometricFields, differentiate, solve_poisson

L = 4
COEFFICIENTS = np.random.default_rng(0).standard_normal((2, 3, 2 * L + 1, 2 * L + 1, 2 * L + 1))
POINTS = np.random.default_rng(1).uniform(-np.pi, np.pi, (20, 3))


def direct(coefficients, x):
    """The documented basis, one function of one variable at a time."""
    phi = [[np.cos(a * t) if a >= 0 else np.sin(-a * t) for a in range(-L, L + 1)] for t in x.T]
    return np.einsum("sabc,an,bn,cn->sn", coefficients, *np.array(phi))


@pytest.mark.parametrize("chunk", [1 << 24, 500])
def test_values_at_points_equal_the_direct_sum(x64, monkeypatch, chunk):
    """The small chunk takes the 20 points in several pieces, the last one not full."""
    monkeypatch.setattr("jaxnbv.surfaces.trigonometric._CHUNK_VALUES", chunk)
    fields = TrigonometricFields(jnp.asarray(COEFFICIENTS[0]))
    np.testing.assert_allclose(fields(POINTS), direct(COEFFICIENTS[0], POINTS), atol=1e-11)


def test_grid_point_and_default_slab_evaluation_agree(x64):
    fields = TrigonometricFields(jnp.asarray(COEFFICIENTS[0]))
    axis = np.linspace(-1.7, 1.3, 7)
    nodes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    expected = direct(COEFFICIENTS[0], nodes).reshape(3, 7, 7, 7)
    np.testing.assert_allclose(fields.on_grid(axis), expected, atol=1e-11)
    np.testing.assert_allclose(Fields.on_grid(fields, axis), expected, atol=1e-11)


def test_ways_to_the_gradient_agree(x64):
    fields = TrigonometricFields(jnp.asarray(COEFFICIENTS[0]))
    automatic = jax.vmap(jax.jacobian(lambda x: fields(x[None])[:, 0]))(jnp.asarray(POINTS))
    np.testing.assert_allclose(fields.gradient(POINTS), automatic.transpose(1, 0, 2), atol=1e-10)
    np.testing.assert_allclose(Fields.gradient(fields, POINTS), automatic.transpose(1, 0, 2), atol=1e-10)
    for axis in range(3):
        derivative = TrigonometricFields(differentiate(fields.coefficients, axis))(POINTS)
        np.testing.assert_allclose(derivative, automatic[..., axis].T, atol=1e-10)
        step = 1e-5 * np.eye(3)[axis]
        central = (direct(COEFFICIENTS[0], POINTS + step) - direct(COEFFICIENTS[0], POINTS - step)) / 2e-5
        np.testing.assert_allclose(derivative, central, atol=1e-6)


def test_poisson_solution_has_the_divergence_as_laplacian_and_mean_zero(x64):
    """Laplacian f = div v at points, the derivatives by central differences of values; h^2 L^2 / 12 is 1.3e-6."""
    v = COEFFICIENTS[:1]
    f = np.asarray(solve_poisson(jnp.asarray(v)))
    h, points = 1e-3, POINTS[:6]

    def shifted(field, axis, sign):
        return direct(field, points + sign * h * np.eye(3)[axis])

    second = sum(shifted(f, d, 1) + shifted(f, d, -1) - 2 * direct(f, points) for d in range(3)) / h**2
    divergence = sum((shifted(v[:, d], d, 1) - shifted(v[:, d], d, -1)) / (2 * h) for d in range(3))
    np.testing.assert_allclose(second, divergence, atol=1e-5 * np.abs(divergence).max())
    assert f[0, L, L, L] == 0
