"""The Matern spectrum on the circle against its lattice sum, and its kernel against the Matern kernel on the line."""

import numpy as np
import pytest
from weight_space import lattice_spectrum

from jaxnbv.surfaces.covariance import circle_spectrum

SMOOTHNESS = (0.5, 1.5, 2.5)

MATERN = {
    0.5: lambda r: np.exp(-r),
    1.5: lambda r: (1 + np.sqrt(3) * r) * np.exp(-np.sqrt(3) * r),
    2.5: lambda r: (1 + np.sqrt(5) * r + 5 * r**2 / 3) * np.exp(-np.sqrt(5) * r),
}


@pytest.mark.parametrize("nu", SMOOTHNESS)
@pytest.mark.parametrize("lengthscale", [0.005, 0.1, 1.0])
def test_spectrum_is_normalised_by_the_sum_over_all_integers(x64, nu, lengthscale):
    spectrum = circle_spectrum(nu, lengthscale, 0.7, 20)
    np.testing.assert_allclose(spectrum, lattice_spectrum(nu, lengthscale, 0.7, 20), rtol=1e-9)


@pytest.mark.parametrize("nu", SMOOTHNESS)
@pytest.mark.parametrize("lengthscale", [0.02, 0.3])
def test_kernel_is_the_matern_kernel_of_the_line_wrapped_around_the_circle(x64, nu, lengthscale):
    """sum_n s1(n) cos(n t) = variance sum_k m(t / 2 pi + k) / sum_k m(k), by Poisson summation. At the small length
    scale one turn is the whole sum. The 2e-5 is what nu = 1/2 leaves beyond 200,000 frequencies."""
    truncation, variance = 200_000, 0.7
    spectrum = np.asarray(circle_spectrum(nu, lengthscale, variance, truncation))
    t = np.array([0.0, 0.03, 0.2, 0.7, 2.0, np.pi])
    kernel = [spectrum[0] + 2 * np.sum(spectrum[1:] * np.cos(np.arange(1, truncation + 1) * s)) for s in t]
    turns = np.zeros(1) if lengthscale < 0.1 else np.arange(-30, 31)
    on_line = MATERN[nu](np.abs(t[:, None] / (2 * np.pi) + turns) / lengthscale).sum(axis=1)
    np.testing.assert_allclose(kernel, variance * on_line / on_line[0], atol=2e-5)
