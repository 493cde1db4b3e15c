"""The Cholesky factor of a covariance."""

import equinox as eqx
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float

Rows = Float[Array, "n *columns"]


class CholeskyFactor(eqx.Module):
    """C, lower triangular, with A = C C^T."""

    lower: Float[Array, "n n"]

    @classmethod
    def of(cls, matrix: Float[Array, "n n"]) -> "CholeskyFactor":
        """That of a symmetric A, of which one triangle is read; not finite where A is not positive definite."""
        return cls(jnp.linalg.cholesky(matrix, symmetrize_input=False))

    def leading(self, size: int) -> "CholeskyFactor":
        """That of the first rows and columns of A."""
        return CholeskyFactor(self.lower[:size, :size])

    # LAPACK takes matrices by columns: C^T as it lies in memory. C itself would be turned first, which takes ten times
    # as long as the solve.

    def whiten(self, rows: Rows) -> Rows:
        """C^-1 applied to columns."""
        return solve_triangular(self.lower.T, rows, trans="T")

    def unwhiten(self, rows: Rows) -> Rows:
        """C^-T applied to columns."""
        return solve_triangular(self.lower.T, rows)

    def solve(self, rows: Rows) -> Rows:
        """A^-1 applied to columns."""
        return self.unwhiten(self.whiten(rows))

    @property
    def log_determinant(self) -> Float[Array, ""]:
        """log det A."""
        return 2.0 * jnp.sum(jnp.log(jnp.diag(self.lower)))
