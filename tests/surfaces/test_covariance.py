"""Prior covariances against sums over the whole lattice, their Poisson relations, and the joint matrix."""

import jax.numpy as jnp
import numpy as np
import pytest
from weight_space import lattice, lattice_spectrum

from jaxnbv.surfaces.covariance import (
    circle_spectrum,
    function_covariance,
    function_normal_covariance,
    function_variance,
    normal_covariance,
)

RNG = np.random.default_rng(0)
X, Y = RNG.uniform(-1.5, 1.5, (7, 3)), RNG.uniform(-1.5, 1.5, (5, 3))
Y[0] = X[0]


def brute_force(x, y, spectrum):
    """k_vv (n, m), k_fv (3, n, m) and k_ff (n, m), a term for each of the (2 L + 1)^3 frequencies."""
    n = lattice(len(spectrum) - 1)
    s = spectrum[np.abs(n)].prod(axis=1)
    squared = (n**2).sum(axis=1)
    inverse = np.where(squared == 0, 0.0, 1.0 / np.maximum(squared, 1))
    angle = (x[:, None] - y[None]) @ n.T
    cross = np.stack([np.sin(angle) @ (s * n[:, d] * inverse) for d in range(3)])
    return np.cos(angle) @ s, cross, np.cos(angle) @ (s * inverse)


@pytest.mark.parametrize(
    ("nu", "lengthscale", "truncation"), [(0.5, 0.05, 12), (1.5, 0.2, 6), (2.5, 0.005, 12), (1.5, 0.1, 1)]
)
def test_covariances_equal_lattice_sums(x64, nu, lengthscale, truncation):
    spectrum = lattice_spectrum(nu, lengthscale, 0.4, truncation)
    expected = brute_force(X, Y, spectrum)
    x, y, s = jnp.asarray(X), jnp.asarray(Y), jnp.asarray(spectrum)
    functions = (normal_covariance, function_normal_covariance, function_covariance)
    for function, value in zip(functions, expected, strict=True):
        np.testing.assert_allclose(function(x, y, s), value, atol=1e-12 * np.abs(value).max(), rtol=1e-12)
    np.testing.assert_allclose(function_variance(s), expected[2][0, 0], rtol=1e-12)


def test_covariances_equal_lattice_sums_in_float32_at_the_default_settings():
    """L = 50 and ell = 0.005: a million frequencies; errors relative to the largest value of each kernel."""
    spectrum = lattice_spectrum(1.5, 0.005, 0.2, 50)
    x, y = X[:2], Y[:2]
    expected = brute_force(x, y, spectrum)
    x, y, s = (jnp.asarray(a, jnp.float32) for a in (x, y, circle_spectrum(1.5, 0.005, 0.2, 50)))
    scales = (0.2**3, np.sqrt(expected[2][0, 0] * 0.2**3), expected[2][0, 0])
    functions = (normal_covariance, function_normal_covariance, function_covariance)
    for function, value, scale in zip(functions, expected, scales, strict=True):
        np.testing.assert_allclose(function(x, y, s), value, atol=2e-5 * scale)
    np.testing.assert_allclose(function_variance(s), expected[2][0, 0], rtol=2e-5)
