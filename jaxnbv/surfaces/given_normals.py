"""p(f | D) under `GeometricSPSR`: its closed forms, and what is drawn and solved for its samples.

    factor   A = k(X, X) + noise^2 I = C C^T; of more points than `MOST_FACTORISED` A^-1 is by conjugate gradients
    mean     Poisson(k(., X) A^-1 n)
    sample   Poisson(v + k(., X) A^-1 (n - v(X) - eps)), v and eps from the prior

Names are those of `jaxnbv.surfaces.spsr`. Clouds are partly filled: a row of A that is not filled is one of the
identity, which changes neither solves nor determinants.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array, Float, PRNGKeyArray

from jaxnbv.checks import AnyArray, InputError
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.sharding import shared_map
from jaxnbv.surfaces.base import on_torus
from jaxnbv.surfaces.covariance import (
    Scalar,
    Spectra,
    function_covariance,
    function_normal_covariance,
    function_variance,
    mode_variance,
    normal_covariance,
)
from jaxnbv.surfaces.factor import CholeskyFactor
from jaxnbv.surfaces.pathwise import DataPoints, MeansAtData, TrigonometricPosterior, filled
from jaxnbv.surfaces.trigonometric import NonuniformTransform, solve_poisson

MOST_FACTORISED = 16384
"""The capacity up to which A is factorised: 1.1 GB in float32, and as much again while it is."""

_CHUNK_VALUES = 2**24
_ALWAYS_WHOLE = 2048
_MOST_PRODUCTS = 2000


def factorise(cloud: PointCloud, spectrum: Spectra, noise: Scalar) -> CholeskyFactor:
    """The Cholesky factor C of A, with as many rows as the cloud has room for."""
    capacity = cloud.capacity

    def leading(size: int):
        points, mask = cloud.points[:size], cloud.mask[:size]
        kernel = jnp.where(mask[:, None] & mask, normal_covariance(points, points, spectrum), 0.0)
        block = kernel + jnp.diag(jnp.where(mask, noise**2, 1.0))
        upper = CholeskyFactor.of(block).upper
        return jnp.eye(capacity, dtype=upper.dtype).at[:size, :size].set(upper)

    return CholeskyFactor(_on_filled_rows(cloud, leading))


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


def by_conjugate_gradients(
    rows: Float[Array, "s n 3"], cloud: PointCloud, spectrum: Spectra, noise: Scalar
) -> Float[Array, "s n 3"]:
    """A^-1 applied to the columns of each block, which are zero in rows that are not filled; NaN where that did not
    converge. A is never made: A = Phi S Phi^T + noise^2 I, with Phi the basis at the data and S the variances of the
    modes, so a product is a transform to coefficients and back; for 50,000 points with L = 50 about 200 will do."""
    tolerance = float(jnp.finfo(rows.dtype).eps) ** 0.8

    def solved(rows, transform, variance, noise, mask):
        def product(rows):
            return jnp.where(mask, transform.evaluate(variance * transform.adjoint(rows)), 0.0) + noise**2 * rows

        found, _ = cg(product, rows, tol=tolerance, maxiter=_MOST_PRODUCTS)
        left = jnp.linalg.norm(rows - product(found)) / jnp.linalg.norm(rows)
        return jnp.where(left < 10 * tolerance, found, jnp.nan)

    transform = NonuniformTransform(cloud.points, spectrum.shape[-1] - 1)
    return shared_map(solved, rows, transform, mode_variance(spectrum), noise, cloud.mask[:, None])


class NormalDraws(NamedTuple):
    """v drawn from the prior, by its coefficients, and v(X) + eps."""

    coefficients: Float[Array, "s 3 a a a"]
    at_data: Float[Array, "s n 3"]


class GeometricSPSRPosterior(TrigonometricPosterior):
    """p(f | D) under `GeometricSPSR`, in closed form and as pathwise samples.

    - `level`: mean over the data of E f(x_j); the surface is where f equals it.
    - `mean_coefficients`: of E f, see `surfaces/trigonometric.py`.
    - `cloud`: D, with zeros in the rows that are not filled.
    - `weights`: A^-1 n.
    - `spectrum`, `noise`: of the prior and of the normals.
    - `cholesky`: C; None of more points than are factorised. Then a variance is a solve each, samples and means are
      exact to 1e-4 of the largest value in float32, and `covariance` and `log_marginal_likelihood` are not offered.
    """

    level: Float[Array, ""]
    mean_coefficients: Float[Array, "a a a"]
    cloud: PointCloud
    weights: Float[Array, "n 3"]
    spectrum: Spectra
    noise: Scalar
    cholesky: CholeskyFactor | None

    @property
    def truncation(self) -> int:
        """L."""
        return self.spectrum.shape[-1] - 1

    @on_torus
    @eqx.filter_jit
    def variance(self, x: Float[AnyArray, "n 3"]) -> Float[Array, " n"]:
        """Var f(x) at points in scene coordinates. The cost grows with (number of points) x (capacity)^2."""
        x = jnp.asarray(x, dtype=self.weights.dtype)
        prior = function_variance(self.spectrum)

        def at_point(point):
            if self.cholesky is None:
                cross = function_normal_covariance(point[None], self.cloud.points, self.spectrum)[:, 0].T
                cross = jnp.where(self.cloud.mask[:, None], cross, 0.0)
                return jnp.maximum(prior - jnp.sum(cross * self.solve(cross[None])[0]), 0.0)
            return jnp.maximum(prior - jnp.sum(self.whitened(point[None]) ** 2), 0.0)

        chunk = None if self.cholesky is None else max(1, min(x.shape[0], _CHUNK_VALUES // self.cloud.capacity))
        return jax.lax.map(at_point, x, batch_size=chunk)

    @on_torus
    @eqx.filter_jit
    def covariance(self, x: Float[AnyArray, "n 3"], y: Float[AnyArray, "m 3"]) -> Float[Array, "n m"]:
        """Cov(f(x), f(y)) between points in scene coordinates, all at once."""
        x, y = (jnp.asarray(points, dtype=self.weights.dtype) for points in (x, y))
        explained = jnp.einsum("djn,djm->nm", self.whitened(x), self.whitened(y), precision="highest")
        return function_covariance(x, y, self.spectrum) - explained

    def log_marginal_likelihood(self) -> Float[Array, ""]:
        """log p(n_1, ..., n_N | x_1, ..., x_N), summed over the three components."""
        count = self.cloud.count
        fit = jnp.sum(self.cloud.normals * self.weights)
        return -0.5 * (fit + 3.0 * self.factor.log_determinant + 3.0 * count * jnp.log(2.0 * jnp.pi))

    def whitened(self, x: Float[Array, "n 3"]) -> Float[Array, "3 capacity n"]:
        """C^-1 cov(v_d(X), f(x)): the sum of its squares is the variance that the data explain."""
        capacity = self.cloud.capacity

        def leading(size: int):
            cross = function_normal_covariance(x, self.cloud.points[:size], self.spectrum)
            cross = jnp.where(self.cloud.mask[:size], cross, 0.0)
            solved = _of_columns(self.factor.leading(size).whiten, jnp.swapaxes(cross, 1, 2))
            return jnp.pad(solved, ((0, 0), (0, capacity - size), (0, 0)))

        return _on_filled_rows(self.cloud, leading)

    def data_points(self) -> DataPoints:
        """The cloud's, for gradients and for values."""
        points = filled(self.cloud.points, self.cloud.mask)
        return DataPoints(points, points)

    def level_about(self, means: MeansAtData) -> Float[Array, " s"]:
        """Mean over the data of what m_s adds to E f(x_j): m_s(x_j) itself, less what grad m_s takes from the normals.
        The latter is linear in them, so that its slope is computed once for all means."""
        explained = jnp.einsum("snd,nd->s", means.gradients, _level_slope(self), precision="highest")
        return jnp.mean(means.values, axis=1, where=self.cloud.mask) - explained

    def prior_draws(self, key: PRNGKeyArray, num_samples: int) -> NormalDraws:
        """Draws of v and of eps."""
        scale, dtype = jnp.sqrt(mode_variance(self.spectrum)), self.weights.dtype
        modes, shape = scale.shape[0], self.cloud.points.shape
        transform = NonuniformTransform(self.cloud.points, self.truncation)
        field_keys, noise_keys = jax.random.split(key, (2, num_samples))

        def prior(keys, scale, deviation, transform):
            field_key, noise_key = keys
            coefficients = scale * jax.random.normal(field_key, (3, modes, modes, modes), dtype)
            noise = deviation * jax.random.normal(noise_key, shape, dtype)
            return NormalDraws(coefficients, transform.evaluate(coefficients) + noise)

        return shared_map(prior, (field_keys, noise_keys), scale, self.noise, transform)

    def conditioned(self, draws: NormalDraws, means: MeansAtData) -> Float[Array, "s a a a"]:
        """Coefficients of Poisson(v + k(., X) A^-1 (n - grad m - v(X) - eps))."""
        return self._reconstructed(draws.coefficients, self.solve(self._residual(draws, means)))

    def _residual(self, draws: NormalDraws, means: MeansAtData) -> Float[Array, "s n 3"]:
        """n - grad m - v(X) - eps, zero in rows that are not filled."""
        return jnp.where(self.cloud.mask[:, None], self.cloud.normals - means.gradients - draws.at_data, 0.0)

    def whitened_residual(self, draws: NormalDraws, means: MeansAtData) -> Float[Array, "s n 3"]:
        """C^-1 (n - grad m - v(X) - eps), zero in rows that are not filled."""
        return _of_columns(self.factor.whiten, self._residual(draws, means))

    def updated(
        self, coefficients: Float[Array, "s 3 a a a"], whitened: Float[Array, "s n 3"]
    ) -> Float[Array, "s a a a"]:
        """Coefficients of Poisson(v + k(., X) C^-T z) for each v and each whitened residual z."""
        return self._reconstructed(coefficients, _of_columns(self.factor.unwhiten, whitened))

    def _reconstructed(
        self, coefficients: Float[Array, "s 3 a a a"], weights: Float[Array, "s n 3"]
    ) -> Float[Array, "s a a a"]:
        transform = NonuniformTransform(self.cloud.points, self.truncation)

        def update(sample, transform, spectrum):
            coefficients, weights = sample
            return solve_poisson(coefficients) + reconstruct(transform, weights, spectrum)

        return shared_map(update, (coefficients, weights), transform, self.spectrum)

    def solve(self, rows: Float[Array, "s n 3"]) -> Float[Array, "s n 3"]:
        """A^-1 applied to the columns of each block."""
        if self.cholesky is None:
            return by_conjugate_gradients(rows, self.cloud, self.spectrum, self.noise)
        return _of_columns(self.cholesky.solve, rows)

    @property
    def factor(self) -> CholeskyFactor:
        """C.

        **Raises:** `ValueError` of more points than are factorised.
        """
        if self.cholesky is None:
            raise InputError(f"the factor of more than {MOST_FACTORISED} points is not made: keep fewer")
        return self.cholesky


def _of_columns(solve: Callable[[Array], Array], blocks: Float[Array, "s n k"]) -> Float[Array, "s n k"]:
    """A solve of the columns of all blocks together."""
    columns = jnp.moveaxis(blocks, 0, 1)
    return jnp.moveaxis(solve(columns.reshape(len(columns), -1)).reshape(columns.shape), 1, 0)


@eqx.filter_jit
def given_normals(cloud: PointCloud, spectrum: Spectra, noise: Scalar) -> GeometricSPSRPosterior:
    """p(f | D), by the factor of A up to a capacity of `MOST_FACTORISED`, by conjugate gradients beyond."""
    # Whatever stands in rows that are not filled, NaN included, must not reach the products.
    points, normals = (jnp.where(cloud.mask[:, None], rows, 0.0) for rows in (cloud.points, cloud.normals))
    cloud, cholesky = PointCloud(points, normals, cloud.mask), None
    if cloud.capacity > MOST_FACTORISED:
        weights = by_conjugate_gradients(cloud.normals[None], cloud, spectrum, noise)[0]
    else:
        cholesky = factorise(cloud, spectrum, noise)
        weights = cholesky.solve(cloud.normals)
    transform = NonuniformTransform(cloud.points, spectrum.shape[-1] - 1)
    mean = reconstruct(transform, weights, spectrum)
    level = mean_at_data(transform, mean, cloud)
    return GeometricSPSRPosterior(level, mean, cloud, weights, spectrum, noise, cholesky)


def reconstruct(
    transform: NonuniformTransform, weights: Float[Array, "n 3"], spectrum: Spectra
) -> Float[Array, "a a a"]:
    """Coefficients of the f that k(., X) weights reconstructs: its Laplacian is their divergence."""
    return solve_poisson(mode_variance(spectrum) * transform.adjoint(weights))


def mean_at_data(
    transform: NonuniformTransform, coefficients: Float[Array, "a a a"], cloud: PointCloud
) -> Float[Array, ""]:
    """Mean of f over the filled rows of a cloud, the points of the transform."""
    at_data = transform.evaluate(coefficients[None])[:, 0]
    return jnp.sum(jnp.where(cloud.mask, at_data, 0.0)) / jnp.sum(cloud.mask)


@eqx.filter_jit
def _level_slope(posterior: GeometricSPSRPosterior) -> Float[Array, "n 3"]:
    """Derivative of the level with respect to the normals: A^-1 of that with respect to A^-1 n."""
    cloud, spectrum = posterior.cloud, posterior.spectrum
    transform = NonuniformTransform(cloud.points, posterior.truncation)

    def damped(fields):
        return solve_poisson(mode_variance(spectrum) * fields)

    # The transforms are each other's transposes, and take a tenth of the time of those that JAX derives.
    at_data = transform.adjoint(cloud.mask[:, None] / jnp.sum(cloud.mask))[0]
    fields = jax.ShapeDtypeStruct((3, *at_data.shape), at_data.dtype)
    slope = transform.evaluate(jax.linear_transpose(damped, fields)(at_data)[0])
    return posterior.solve(jnp.where(cloud.mask[:, None], slope, 0.0)[None])[0]
