"""The Matern spectrum and prior covariances against sums over the whole lattice, and the one-dimensional kernel."""

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
X, Y = RNG.uniform(-1.5, 1.5, (2, 2, 3))
Y[0] = X[0]
FUNCTIONS = (normal_covariance, function_normal_covariance, function_covariance)


def brute_force(x, y, spectrum):
    """k_vv (n, m), k_fv (3, n, m) and k_ff (n, m), with a term for each of the (2 L + 1)^3 frequencies."""
    n = lattice(len(spectrum) - 1)
    s = spectrum[np.abs(n)].prod(axis=1)
    squared = (n**2).sum(axis=1)
    inverse = np.where(squared == 0, 0.0, 1.0 / np.maximum(squared, 1))
    angle = (x[:, None] - y[None]) @ n.T
    cross = np.stack([np.sin(angle) @ (s * n[:, d] * inverse) for d in range(3)])
    return np.cos(angle) @ s, cross, np.cos(angle) @ (s * inverse)


def test_covariances_equal_lattice_sums(x64):
    """At a short lengthscale, for which high frequencies count."""
    spectrum = lattice_spectrum(0.5, 0.005, 0.4, 12)
    x, y, s = jnp.asarray(X), jnp.asarray(Y), circle_spectrum(0.5, 0.005, 0.4, 12)
    expected = brute_force(X, Y, spectrum)
    for function, value in zip(FUNCTIONS, expected, strict=True):
        np.testing.assert_allclose(function(x, y, s), value, atol=1e-9 * np.abs(value).max())
    np.testing.assert_allclose(function_variance(s), expected[2][0, 0], rtol=1e-9)


def test_covariances_equal_lattice_sums_in_float32_at_the_default_settings():
    """L = 50 and ell = 0.005, a million frequencies. Errors are relative to the largest value of each kernel."""
    spectrum = lattice_spectrum(1.5, 0.005, 0.2, 50)
    expected = brute_force(X, Y, spectrum)
    x, y, s = (jnp.asarray(a, jnp.float32) for a in (X, Y, circle_spectrum(1.5, 0.005, 0.2, 50)))
    scales = (0.2**3, np.sqrt(expected[2][0, 0] * 0.2**3), expected[2][0, 0])
    for function, value, scale in zip(FUNCTIONS, expected, scales, strict=True):
        np.testing.assert_allclose(function(x, y, s), value, atol=2e-5 * scale)
    np.testing.assert_allclose(function_variance(s), expected[2][0, 0], rtol=2e-5)


MATERN = {
    0.5: lambda r: np.exp(-r),
    1.5: lambda r: (1 + np.sqrt(3) * r) * np.exp(-np.sqrt(3) * r),
    2.5: lambda r: (1 + np.sqrt(5) * r + 5 * r**2 / 3) * np.exp(-np.sqrt(5) * r),
}


@pytest.mark.parametrize("nu", MATERN)
@pytest.mark.parametrize("lengthscale", [0.02, 0.3])
def test_kernel_is_the_matern_kernel_of_the_line_wrapped_around_the_circle(x64, nu, lengthscale):
    """sum_n s1(n) cos(n t) = variance sum_k m(t / 2 pi + k) / sum_k m(k), by Poisson summation. At the small length
    scale the term k = 0 is the whole sum. 2e-5 is the remainder for nu = 1/2 beyond 200,000 frequencies."""
    truncation, variance = 200_000, 0.7
    spectrum = np.asarray(circle_spectrum(nu, lengthscale, variance, truncation))
    t = np.array([0.0, 0.03, 0.2, 0.7, 2.0, np.pi])
    kernel = [spectrum[0] + 2 * np.sum(spectrum[1:] * np.cos(np.arange(1, truncation + 1) * s)) for s in t]
    turns = np.zeros(1) if lengthscale < 0.1 else np.arange(-30, 31)
    on_line = MATERN[nu](np.abs(t[:, None] / (2 * np.pi) + turns) / lengthscale).sum(axis=1)
    np.testing.assert_allclose(kernel, variance * on_line / on_line[0], atol=2e-5)
