"""A^-1 for A = k(X, X) + noise^2 I, the covariance of observed normals, in two ways.

    DenseSolver               A = C C^T, factorised once; the factor gives covariances and likelihoods too
    ConjugateGradientSolver   A is never made: A = Phi S Phi^T + noise^2 I, with Phi the basis at the data and S the
                              variances of the modes, so a product is a transform to coefficients and back

Clouds are partly filled: a row of A that is not filled is one of the identity, which changes neither solves nor
determinants.
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
from jaxnbv.surfaces.covariance import (
    Scalar,
    Spectra,
    function_normal_covariance,
    mode_variance,
    normal_covariance,
)
from jaxnbv.surfaces.factor import CholeskyFactor
from jaxnbv.surfaces.trigonometric import NonuniformTransform

MOST_FACTORISED = 16384
"""The capacity up to which A is factorised: 1.1 GB in float32, and as much again while it is."""

_CHUNK_VALUES = 2**24
_ALWAYS_WHOLE = 2048
_MOST_PRODUCTS = 2000


class Solver(eqx.Module):
    """A^-1 for the normals of a cloud.

    - `cloud`: D, with zeros in the rows that are not filled.
    - `spectrum`, `noise`: of the prior and of the normals.

    `whiten`, `unwhiten` and `whitened_cross` need the factor, and raise as `factor` does where there is none.
    """

    cloud: eqx.AbstractVar[PointCloud]
    spectrum: eqx.AbstractVar[Spectra]
    noise: eqx.AbstractVar[Scalar]

    @property
    @abstractmethod
    def factor(self) -> CholeskyFactor:
        """C.

        **Raises:** `ValueError` where A is not factorised.
        """

    @abstractmethod
    def solve(self, blocks: Float[Array, "s n k"]) -> Float[Array, "s n k"]:
        """A^-1 applied to the columns of each block, which are zero in rows that are not filled."""

    @abstractmethod
    def explained_variance(self, x: Float[Array, "n 3"]) -> Float[Array, " n"]:
        """By how much the data lower Var f(x), at points in scene coordinates."""

    def whiten(self, blocks: Float[Array, "s n k"]) -> Float[Array, "s n k"]:
        """C^-1 applied to the columns of each block."""
        return _of_columns(self.factor.whiten, blocks)

    def unwhiten(self, blocks: Float[Array, "s n k"]) -> Float[Array, "s n k"]:
        """C^-T applied to the columns of each block."""
        return _of_columns(self.factor.unwhiten, blocks)

    def whitened_cross(self, x: Float[Array, "n 3"]) -> Float[Array, "3 capacity n"]:
        """C^-1 cov(v_d(X), f(x)): the sum of its squares is the variance that the data explain."""
        capacity, factor = self.cloud.capacity, self.factor

        def leading(size: int):
            cross = function_normal_covariance(x, self.cloud.points[:size], self.spectrum)
            cross = jnp.where(self.cloud.mask[:size], cross, 0.0)
            solved = _of_columns(factor.leading(size).whiten, jnp.swapaxes(cross, 1, 2))
            return jnp.pad(solved, ((0, 0), (0, capacity - size), (0, 0)))

        return _on_filled_rows(self.cloud, leading)


class DenseSolver(Solver):
    """The Cholesky factor of A, with as many rows as the cloud has room for. See `Solver`."""

    cloud: PointCloud
    spectrum: Spectra
    noise: Scalar
    cholesky: CholeskyFactor

    @classmethod
    def of(cls, cloud: PointCloud, spectrum: Spectra, noise: Scalar) -> "DenseSolver":
        """The solver of a cloud, its A factorised."""
        capacity = cloud.capacity

        def leading(size: int):
            points, mask = cloud.points[:size], cloud.mask[:size]
            kernel = jnp.where(mask[:, None] & mask, normal_covariance(points, points, spectrum), 0.0)
            block = kernel + jnp.diag(jnp.where(mask, noise**2, 1.0))
            upper = CholeskyFactor.of(block).upper
            return jnp.eye(capacity, dtype=upper.dtype).at[:size, :size].set(upper)

        return cls(cloud, spectrum, noise, CholeskyFactor(_on_filled_rows(cloud, leading)))

    @property
    def factor(self) -> CholeskyFactor:
        return self.cholesky

    def solve(self, blocks: Float[Array, "s n k"]) -> Float[Array, "s n k"]:
        return _of_columns(self.cholesky.solve, blocks)

    def explained_variance(self, x: Float[Array, "n 3"]) -> Float[Array, " n"]:
        """As `Solver` says. The cost grows with (number of points) x (capacity)^2."""
        return jax.lax.map(
            lambda point: jnp.sum(self.whitened_cross(point[None]) ** 2),
            x,
            batch_size=points_at_once(len(x), self.cloud.capacity),
        )


class ConjugateGradientSolver(Solver):
    """Conjugate gradients for more points than can be factorised: about 200 products for 50,000 points with L = 50.

    A solve that did not converge is NaN. Solutions are exact to 1e-4 of the largest value in float32. See `Solver`.
    """

    cloud: PointCloud
    spectrum: Spectra
    noise: Scalar

    @property
    def factor(self) -> CholeskyFactor:
        raise InputError(
            f"the factor of more than {MOST_FACTORISED} points is not made, and covariances and likelihoods need it: "
            "keep fewer points"
        )

    def solve(self, blocks: Float[Array, "s n k"]) -> Float[Array, "s n k"]:
        tolerance = float(jnp.finfo(blocks.dtype).eps) ** 0.8

        def solved(rows, transform, variance, noise, mask):
            def product(rows):
                return jnp.where(mask, transform.evaluate(variance * transform.adjoint(rows)), 0.0) + noise**2 * rows

            solution, _ = cg(product, rows, tol=tolerance, maxiter=_MOST_PRODUCTS)
            left = jnp.linalg.norm(rows - product(solution)) / jnp.linalg.norm(rows)
            return jnp.where(left < 10 * tolerance, solution, jnp.nan)

        transform = NonuniformTransform(self.cloud.points, self.spectrum.shape[-1] - 1)
        return shared_map(solved, blocks, transform, mode_variance(self.spectrum), self.noise, self.cloud.mask[:, None])

    def explained_variance(self, x: Float[Array, "n 3"]) -> Float[Array, " n"]:
        """As `Solver` says, by a solve for each point."""

        def at_point(point):
            cross = function_normal_covariance(point[None], self.cloud.points, self.spectrum)[:, 0].T
            cross = jnp.where(self.cloud.mask[:, None], cross, 0.0)
            return jnp.sum(cross * self.solve(cross[None])[0])

        return jax.lax.map(at_point, x)


def solver_of(cloud: PointCloud, spectrum: Spectra, noise: Scalar) -> Solver:
    """The solver of a cloud: dense up to a capacity of `MOST_FACTORISED`, by conjugate gradients beyond."""
    if cloud.capacity > MOST_FACTORISED:
        return ConjugateGradientSolver(cloud, spectrum, noise)
    return DenseSolver.of(cloud, spectrum, noise)


def points_at_once(count: int, capacity: int) -> int:
    """How many of `count` points to whiten together, to bound the memory."""
    return max(1, min(count, _CHUNK_VALUES // capacity))


def _on_filled_rows(cloud: PointCloud, leading: Callable[[int], Float[Array, "*of"]]) -> Float[Array, "*of"]:
    """`leading(size)` for a share of the rows, the leading ones, that holds all that are filled: so the time follows
    them while the shapes stay fixed. Each share is compiled, which few rows are not worth."""
    capacity = cloud.capacity
    if capacity <= _ALWAYS_WHOLE:
        return leading(capacity)
    sizes = [-(-capacity * eighths // 8) for eighths in (2, 3, 4, 5, 6, 8)]
    filled = jnp.max(jnp.where(cloud.mask, jnp.arange(capacity) + 1, 0))
    return jax.lax.switch(
        jnp.searchsorted(jnp.asarray(sizes), filled), [functools.partial(leading, size) for size in sizes]
    )


def _of_columns(function: Callable[[Array], Array], blocks: Float[Array, "s n k"]) -> Float[Array, "s n k"]:
    """A function of columns applied to those of all blocks together."""
    columns = jnp.moveaxis(blocks, 0, 1)
    return jnp.moveaxis(function(columns.reshape(len(columns), -1)).reshape(columns.shape), 1, 0)
