"""The Cholesky factor of a covariance."""

import equinox as eqx
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float

Rows = Float[Array, "n *columns"]


class CholeskyFactor(eqx.Module):
    """C, lower triangular, with A = C C^T.

    - `upper`: C^T, which lies in memory as C does by columns. LAPACK takes matrices by columns; others are turned
      first, which takes ten times as long as a solve.
    """

    upper: Float[Array, "n n"]

    @classmethod
    def of(cls, matrix: Float[Array, "n n"]) -> "CholeskyFactor":
        """That of a symmetric A, of which one triangle is read; not finite where A is not positive definite."""
        return cls(jnp.linalg.cholesky(matrix.T, symmetrize_input=False).T)

    def leading(self, size: int) -> "CholeskyFactor":
        """That of the first rows and columns of A."""
        return CholeskyFactor(self.upper[:size, :size])

    def whiten(self, rows: Rows) -> Rows:
        """C^-1 applied to columns."""
        return solve_triangular(self.upper.T, rows, lower=True)

    def unwhiten(self, rows: Rows) -> Rows:
        """C^-T applied to columns."""
        return solve_triangular(self.upper.T, rows, lower=True, trans="T")

    def solve(self, rows: Rows) -> Rows:
        """A^-1 applied to columns."""
        return self.unwhiten(self.whiten(rows))

    @property
    def log_determinant(self) -> Float[Array, ""]:
        """log det A."""
        return 2.0 * jnp.sum(jnp.log(jnp.diag(self.upper)))
