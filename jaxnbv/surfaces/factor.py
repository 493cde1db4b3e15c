"""The Cholesky factor of a covariance."""

import equinox as eqx
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float

Rows = Float[Array, "n *columns"]


class CholeskyFactor(eqx.Module):
    """The Cholesky factor of a covariance A: the lower triangular C with A = C C^T.

    - `upper`: C^T. LAPACK requires C in column-major order, which is C^T in row-major order. A row-major C would have
      to be transposed before each solve, which takes ten times as long as the solve.
    """

    upper: Float[Array, "n n"]

    @classmethod
    def of(cls, matrix: Float[Array, "n n"]) -> "CholeskyFactor":
        """Factorise A, reading its upper triangle. The factor is not finite unless A is positive definite."""
        return cls(jnp.linalg.cholesky(matrix.T, symmetrize_input=False).T)

    def leading(self, size: int) -> "CholeskyFactor":
        """Return the factor of the first `size` rows and columns of A."""
        return CholeskyFactor(self.upper[:size, :size])

    def whiten(self, rows: Rows) -> Rows:
        """Apply C^-1 to each column of `rows`."""
        return solve_triangular(self.upper.T, rows, lower=True)

    def unwhiten(self, rows: Rows) -> Rows:
        """Apply C^-T, the inverse of the transpose of C, to each column of `rows`."""
        return solve_triangular(self.upper.T, rows, lower=True, trans="T")

    def solve(self, rows: Rows) -> Rows:
        """Apply A^-1 to each column of `rows`."""
        return self.unwhiten(self.whiten(rows))

    @property
    def log_determinant(self) -> Float[Array, ""]:
        """Logarithm of the determinant of A."""
        return 2.0 * jnp.sum(jnp.log(jnp.diag(self.upper)))
