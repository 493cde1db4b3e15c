"""The Cholesky factor of a covariance, against NumPy in float64."""

import jax.numpy as jnp
import numpy as np

from jaxnbv.surfaces.factor import CholeskyFactor

RNG = np.random.default_rng(0)
ROOT = RNG.standard_normal((12, 20))
MATRIX = ROOT @ ROOT.T
LOWER = np.linalg.cholesky(MATRIX)


def test_solves_and_determinant_are_those_of_the_matrix(x64):
    factor = CholeskyFactor.of(jnp.asarray(MATRIX))
    for rows in (RNG.standard_normal(12), RNG.standard_normal((12, 3))):
        np.testing.assert_allclose(factor.whiten(jnp.asarray(rows)), np.linalg.solve(LOWER, rows), atol=1e-12)
        np.testing.assert_allclose(factor.unwhiten(jnp.asarray(rows)), np.linalg.solve(LOWER.T, rows), atol=1e-12)
        np.testing.assert_allclose(factor.solve(jnp.asarray(rows)), np.linalg.solve(MATRIX, rows), atol=1e-12)
    np.testing.assert_allclose(factor.log_determinant, np.linalg.slogdet(MATRIX)[1], atol=1e-12)
    first = RNG.standard_normal(5)
    np.testing.assert_allclose(
        factor.leading(5).solve(jnp.asarray(first)), np.linalg.solve(MATRIX[:5, :5], first), atol=1e-12
    )


def test_a_matrix_that_is_not_positive_definite_has_a_factor_that_is_not_finite():
    assert not np.isfinite(CholeskyFactor.of(jnp.asarray(MATRIX - 100.0 * np.eye(12))).upper).all()
