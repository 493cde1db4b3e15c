"""Two solvers for A = k(X, X) + noise^2 I, the covariance of the observed normals.

    DenseSolver               factorises A = C C^T once; the factor also gives covariances and likelihoods
    ConjugateGradientSolver   never forms A: A = Phi S Phi^T + noise^2 I, with Phi the basis at the data and S the
                              variances of the modes, so A times a vector is a transform to coefficients and back

X are the points of a cloud, and k is the prior covariance of the normal field. If rows of a cloud are unfilled, the
corresponding rows of A are rows of the identity, which change neither solves nor determinants.
"""

import functools
from abc import abstractmethod
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array, Float

from jaxnbv.checks import InputError
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.sharding import shared_map
from jaxnbv.surfaces.covariance import Scalar, Spectra, function_normal_covariance, mode_variance, normal_covariance
from jaxnbv.surfaces.factor import CholeskyFactor
from jaxnbv.surfaces.trigonometric import NonuniformTransform

MAX_DENSE_CAPACITY = 16384
"""Largest capacity for which A is factorised. A then takes 1.1 GB in float32, and 2.2 GB during factorisation."""

_CHUNK_VALUES = 2**24
_SMALL_CAPACITY = 2048
_MAX_PRODUCTS = 2000


class Solver(eqx.Module):
    """A solver for the covariance A of the normals of a cloud.

    - `cloud`: D, with zeros in unfilled rows.
    - `noise`: standard deviation of the noise of each component of the normals.

    `whiten`, `unwhiten` and `whitened_cross` raise `ValueError` if A is not factorised.
    """

    cloud: eqx.AbstractVar[PointCloud]
    spectrum: eqx.AbstractVar[Spectra]
    noise: eqx.AbstractVar[Scalar]

    @property
    @abstractmethod
    def factor(self) -> CholeskyFactor:
        """The Cholesky factor of A. **Raises:** `ValueError` if A is not factorised."""

    @abstractmethod
    def solve(self, matrices: Float[Array, "s n k"]) -> Float[Array, "s n k"]:
        """Apply A^-1 to each column of each matrix.

        Row i of a matrix belongs to row i of the cloud, and must be zero if the cloud's row i is unfilled.
        """

    @abstractmethod
    def explained_variance(self, x: Float[Array, "n 3"]) -> Float[Array, " n"]:
        """Return how much the data reduce Var f(x), at points in scene coordinates."""

    def whiten(self, matrices: Float[Array, "s n k"]) -> Float[Array, "s n k"]:
        """Apply C^-1 to each column, with A = C C^T (Cholesky). See `solve` for `matrices`."""
        return _apply_to_leading_rows(CholeskyFactor.whiten, self.factor, self.cloud, matrices)

    def unwhiten(self, matrices: Float[Array, "s n k"]) -> Float[Array, "s n k"]:
        """Apply C^-T to each column, with A = C C^T (Cholesky). See `solve` for `matrices`."""
        return _apply_to_leading_rows(CholeskyFactor.unwhiten, self.factor, self.cloud, matrices)

    def whitened_cross(self, x: Float[Array, "n 3"]) -> Float[Array, "3 capacity n"]:
        """Return C^-1 cov(v_d(X), f(x)) for each component d of the normal field v at the cloud's points X.

        The sum of squares over d and the data is the part of Var f(x) that the data explain.
        """
        factor = self.factor

        def whiten_rows(size: int):
            cross = function_normal_covariance(x, self.cloud.points[:size], self.spectrum)
            cross = jnp.where(self.cloud.mask[:size], cross, 0.0)
            return _pad_rows(_apply_to_columns(factor.leading(size).whiten, jnp.swapaxes(cross, 1, 2)), self.cloud)

        return _call_on_leading_rows(self.cloud, whiten_rows)


class DenseSolver(Solver):
    """A solver that factorises A. See `Solver`."""

    cloud: PointCloud
    spectrum: Spectra
    noise: Scalar
    cholesky: CholeskyFactor

    @classmethod
    def of(cls, cloud: PointCloud, spectrum: Spectra, noise: Scalar) -> "DenseSolver":
        """Return a solver with the Cholesky factor of A. See `Solver` for the arguments."""
        capacity = cloud.capacity

        def factorise(size: int):
            points, mask = cloud.points[:size], cloud.mask[:size]
            kernel = jnp.where(mask[:, None] & mask, normal_covariance(points, points, spectrum), 0.0)
            covariance = kernel + jnp.diag(jnp.where(mask, noise**2, 1.0))
            upper = CholeskyFactor.of(covariance).upper
            return jnp.eye(capacity, dtype=upper.dtype).at[:size, :size].set(upper)

        return cls(cloud, spectrum, noise, CholeskyFactor(_call_on_leading_rows(cloud, factorise)))

    @property
    def factor(self) -> CholeskyFactor:
        return self.cholesky

    def solve(self, matrices: Float[Array, "s n k"]) -> Float[Array, "s n k"]:
        return _apply_to_leading_rows(CholeskyFactor.solve, self.cholesky, self.cloud, matrices)

    def explained_variance(self, x: Float[Array, "n 3"]) -> Float[Array, " n"]:
        """Return how much the data reduce Var f(x), at a cost of (number of points) x (capacity)^2."""
        return jax.lax.map(
            lambda point: jnp.sum(self.whitened_cross(point[None]) ** 2),
            x,
            batch_size=points_per_batch(len(x), self.cloud.capacity),
        )


class ConjugateGradientSolver(Solver):
    """A solver by conjugate gradients, for an A that is too large to factorise. See `Solver`.

    A solve takes about 200 products with A for 50,000 points and a truncation of 50. In float32 the error of the result
    is at most 1e-4 of the largest value. The result is NaN if the solve did not converge.
    """

    cloud: PointCloud
    spectrum: Spectra
    noise: Scalar

    @property
    def factor(self) -> CholeskyFactor:
        """**Raises:** `ValueError`, because this solver does not factorise A."""
        raise InputError(
            f"covariances and likelihoods need a factorisation, which is done for at most {MAX_DENSE_CAPACITY} points: "
            "keep fewer points"
        )

    def solve(self, matrices: Float[Array, "s n k"]) -> Float[Array, "s n k"]:
        tolerance = float(jnp.finfo(matrices.dtype).eps) ** 0.8

        def solve(rows, transform, variance, noise, mask):
            def product(rows):
                return jnp.where(mask, transform.evaluate(variance * transform.adjoint(rows)), 0.0) + noise**2 * rows

            solution, _ = cg(product, rows, tol=tolerance, maxiter=_MAX_PRODUCTS)
            error = jnp.linalg.norm(rows - product(solution)) / jnp.linalg.norm(rows)
            return jnp.where(error < 10 * tolerance, solution, jnp.nan)

        transform = NonuniformTransform(self.cloud.points, self.spectrum.shape[-1] - 1)
        return shared_map(
            solve, matrices, transform, mode_variance(self.spectrum), self.noise, self.cloud.mask[:, None]
        )

    def explained_variance(self, x: Float[Array, "n 3"]) -> Float[Array, " n"]:
        """Return how much the data reduce Var f(x). Each point takes one solve."""

        def at_point(point):
            cross = function_normal_covariance(point[None], self.cloud.points, self.spectrum)[:, 0].T
            cross = jnp.where(self.cloud.mask[:, None], cross, 0.0)
            return jnp.sum(cross * self.solve(cross[None])[0])

        return jax.lax.map(at_point, x)


def solver_of(cloud: PointCloud, spectrum: Spectra, noise: Scalar) -> Solver:
    """Return a `DenseSolver` up to a capacity of `MAX_DENSE_CAPACITY`, else a `ConjugateGradientSolver`."""
    if cloud.capacity > MAX_DENSE_CAPACITY:
        return ConjugateGradientSolver(cloud, spectrum, noise)
    return DenseSolver.of(cloud, spectrum, noise)


def points_per_batch(count: int, capacity: int) -> int:
    """Return how many of `count` points to process together, if each needs memory for `capacity` rows."""
    return max(1, min(count, _CHUNK_VALUES // capacity))


def _call_on_leading_rows(cloud: PointCloud, compute: Callable[[int], Float[Array, "*of"]]) -> Float[Array, "*of"]:
    """Call `compute(size)` with a `size` for which the first `size` rows of the cloud hold all its points.

    The size is one of a few fixed sizes, the smallest that fits, so the time depends on the number of filled rows. A
    small cloud uses its whole capacity, because each size is compiled separately.
    """
    capacity = cloud.capacity
    if capacity <= _SMALL_CAPACITY:
        return compute(capacity)
    sizes = [-(-capacity * eighths // 8) for eighths in (2, 3, 4, 5, 6, 8)]
    filled = jnp.max(jnp.where(cloud.mask, jnp.arange(capacity) + 1, 0))
    return jax.lax.switch(
        jnp.searchsorted(jnp.asarray(sizes), filled), [functools.partial(compute, size) for size in sizes]
    )


def _apply_to_leading_rows(
    function: Callable[[CholeskyFactor, Array], Array],
    factor: CholeskyFactor,
    cloud: PointCloud,
    matrices: Float[Array, "s n k"],
) -> Float[Array, "s n k"]:
    """Apply a method of `CholeskyFactor` to each column of each matrix, using only the rows that hold points.

    Row i of a matrix belongs to row i of the cloud, and must be zero if the cloud's row i is unfilled. The other rows
    of the result are zero.

    - `function`: called as `function(factor, columns)`, with the factor of the leading rows.
    - `factor`: the factor for all rows.
    """

    def apply(size: int):
        columns = functools.partial(function, factor.leading(size))
        return _pad_rows(_apply_to_columns(columns, matrices[:, :size]), cloud)

    return _call_on_leading_rows(cloud, apply)


def _pad_rows(matrices: Float[Array, "s size k"], cloud: PointCloud) -> Float[Array, "s n k"]:
    return jnp.pad(matrices, ((0, 0), (0, cloud.capacity - matrices.shape[1]), (0, 0)))


def _apply_to_columns(function: Callable[[Array], Array], matrices: Float[Array, "s n k"]) -> Float[Array, "s n k"]:
    """Apply a function to one matrix with the columns of all matrices, and split the result again."""
    columns = jnp.moveaxis(matrices, 0, 1)
    return jnp.moveaxis(function(columns.reshape(len(columns), -1)).reshape(columns.shape), 1, 0)
