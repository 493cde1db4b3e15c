"""Stochastic Poisson surface reconstruction from normals and from observed values of f.

This is a second step of Bayes' rule after `GeometricSPSR`, whose posterior given the normals has mean m and
covariance k:

    level    c ~ N(0, tau^2), broad and independent of f;   g = f - c, and the surface is where g = 0
    data     h value_j = g(y_j) + e_j,   e_j ~ N(0, h^2 noise_j^2),   j = 1, ..., M
    factor   S = k(Y, Y) + tau^2 11^T + Sigma,   k(Y, Y) = K_ff - sum_d K_fd A^-1 K_df
    mean     E g(x) = m(x) + (k(x, Y) + tau^2 1^T) w,   w = S^-1 (h value - m(Y))
    sample   f a sample given the normals, c and e from the prior;   w = S^-1 (h value - f(Y) + c - e)

Here h is half the rise of E f across the scanned surface (see `ScreenedSPSR.offset`), Y are the points y_j, 1 is a
vector of ones, and Sigma is the covariance of e. K_ff is the prior covariance of f(Y), K_df the covariance of component
d of the normals with f(Y), and A the covariance of the normals.

The values change f by k(., Y) w, which is the sum of two changes. The weights of the normals change by
u_d = -A^-1 K_df w, and the coefficients of f change by s(n) / |n|^2 sum_j w_j e^{-i n.y_j}. The level c changes by
-tau^2 1^T w. The three components of the normal field still share A.
"""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from jaxnbv.checks import AnyArray, check_fields, is_traced, require, short_text
from jaxnbv.geometry.cloud import PointCloud, some_rows
from jaxnbv.observations import Observations, as_observations
from jaxnbv.programs import program
from jaxnbv.sharding import shared_map
from jaxnbv.surfaces.base import SurfaceModel, on_torus
from jaxnbv.surfaces.covariance import function_covariance, function_variance, mode_variance
from jaxnbv.surfaces.factor import CholeskyFactor
from jaxnbv.surfaces.given_normals import GeometricSPSRPosterior, NormalDraws
from jaxnbv.surfaces.pathwise import DataPoints, MeansAtData, TrigonometricPosterior, fill_rows
from jaxnbv.surfaces.solver import MAX_DENSE_CAPACITY, points_per_batch
from jaxnbv.surfaces.spsr import GeometricSPSR
from jaxnbv.surfaces.trigonometric import NonuniformTransform, inverse_laplacian, solve_poisson
from jaxnbv.surfaces.values import EmptySpace, OnSurface, OutsideBoundary, ValueRows, ValueSource, concatenate_rows

_NUM_UNIT_POINTS = 256


class ScreenedSPSR(SurfaceModel):
    """`GeometricSPSR` conditioned on values of f as well as on normals.

    The defaults were the best over validation objects in `benchmarks/imagination.py`.

    - `base`: the prior, and the noise of the normals. The default has a short lengthscale for detail, and a long
      lengthscale for the overall shape, so that values affect f far from their points.
    - `values`: sources of values, see `jaxnbv.surfaces.values`.
    - `level_deviation`: prior standard deviation of the level, which is broad compared with the values of f.
    - `offset`: distance from the surface, in scene units, at which the unit h of values is measured. The rise at a
      point x_j is E f(x_j + offset n_j) - E f(x_j - offset n_j), outside minus inside, given the normals alone. h is
      half the median rise. On a thin sheet the two sides cancel and the rise is near zero, so h is at least half the
      prior standard deviation of f.

    N normals and M values take 3 N^2 M + M^3 operations in addition to the cost of `base`.

    **Raises:** `ValueError` if there are no values, or if `level_deviation` or `offset` is not positive.
    """

    base: GeometricSPSR = eqx.field(default_factory=lambda: GeometricSPSR((0.01, 0.06), (0.2, 0.25), truncation=32))
    values: tuple[ValueSource, ...] = eqx.field(default_factory=lambda: (OutsideBoundary(), OnSurface(), EmptySpace()))
    level_deviation: float = eqx.field(static=True, default=0.5)
    offset: float = eqx.field(static=True, default=0.1)

    def __check_init__(self):
        check_fields(self)
        are_sources = isinstance(self.values, tuple) and all(isinstance(value, ValueSource) for value in self.values)
        require(
            are_sources,
            f"the values are {short_text(self.values)}; give a tuple such as (OutsideBoundary(), OnSurface())",
        )
        require(len(self.values) > 0, "no values are given: name some, such as OutsideBoundary(), or use GeometricSPSR")
        for name in ("level_deviation", "offset"):
            value = getattr(self, name)
            require(0 < value < math.inf, f"{name} is {value}; it must be positive and finite")

    def check(self, cloud: PointCloud) -> None:
        self.base.check(cloud)

    def condition(self, observations: Observations | PointCloud) -> "ScreenedSPSRPosterior":
        """Return the posterior of g = f - c, where c is the level of f, given the cloud and empty space.

        **Raises:** `ValueError` for a capacity above 16,384, for values that are not finite or at points outside
        [-pi/2, pi/2]^3, if the covariance of the values is singular in the dtype's precision, and whenever
        `GeometricSPSR.condition` raises it. Under `jit` values cannot be checked, and the posterior is NaN instead.
        """
        observations = as_observations(observations)
        capacity = observations.cloud.capacity
        require(
            capacity <= MAX_DENSE_CAPACITY,
            f"the cloud has room for {capacity} points, and this model takes {MAX_DENSE_CAPACITY} at most: lower the "
            "planner's capacity, or use GeometricSPSR, which takes more",
        )
        posterior = _condition(self, self.base.condition(observations), observations)
        posterior.rows.check()
        if not is_traced(posterior.weights):
            require(
                bool(jnp.isfinite(posterior.weights).all()),
                f"the covariance of {posterior.rows.points.shape[0]} values is singular in {posterior.weights.dtype}: "
                "raise their noise, or enable jax_enable_x64",
            )
        return posterior


@program
def _condition(
    model: ScreenedSPSR, base: GeometricSPSRPosterior, observations: Observations
) -> "ScreenedSPSRPosterior":
    # Use `base.cloud`, which has zeros in unfilled rows, where `observations.cloud` may hold NaN.
    observations = eqx.tree_at(lambda e: e.cloud, observations, base.cloud)
    spectrum, rows = model.base.spectrum, concatenate_rows(model.values, observations)
    value_unit = _value_unit(base, model.offset)
    whitened_cross = jnp.where(rows.mask, base.solver.whitened_cross(rows.points), 0.0)
    explained = jnp.einsum("dnk,dnl->kl", whitened_cross, whitened_cross, precision="highest")
    level_variance = model.level_deviation**2
    covariance = function_covariance(rows.points, rows.points, spectrum) - explained + level_variance
    covariances = jnp.where(rows.mask[:, None] & rows.mask, covariance, 0.0)
    # An unfilled row becomes a row of the identity, and its weight becomes zero.
    factor = CholeskyFactor.of(covariances + jnp.diag(jnp.where(rows.mask, (value_unit * rows.noise) ** 2, 1.0)))

    # Start with the posterior given the normals alone. Its weights and mean are replaced at the end.
    level, zeros = jnp.zeros_like(base.level), jnp.zeros_like(rows.values)
    posterior = ScreenedSPSRPosterior(
        level, base.mean_coefficients, model, base, rows, value_unit, whitened_cross, factor, zeros
    )
    transform = NonuniformTransform(rows.points, model.base.truncation)
    row_values = transform.evaluate(base.mean_coefficients[None])[:, 0]
    weights = posterior.solve(value_unit * rows.values - row_values)
    zero_draw = jnp.zeros((1, 3, *base.mean_coefficients.shape), row_values.dtype)
    normals = base.solver.whiten(base.cloud.normals[None])
    mean = posterior._update_draws(zero_draw, normals, jnp.zeros(1, row_values.dtype), weights[None])[0]
    return eqx.tree_at(lambda p: (p.weights, p.mean_coefficients), posterior, (weights, mean))


def _value_unit(base: GeometricSPSRPosterior, offset: float) -> Float[Array, ""]:
    """Return h, the unit of observed values, see `ScreenedSPSR.offset`."""
    rows = some_rows(base.cloud, _NUM_UNIT_POINTS)
    points, step = base.cloud.points[rows], offset * base.cloud.normals[rows]
    mean = base.mean_field
    smallest = 0.5 * jnp.sqrt(function_variance(base.spectrum))
    return jnp.maximum(0.5 * jnp.median(mean(points + step)[0] - mean(points - step)[0]), smallest)


class ScreenedDraws(NamedTuple):
    """Draws from the prior: normal field and its noise, level c, and noise e of the observed values."""

    normals: NormalDraws
    level: Float[Array, " s"]
    noise: Float[Array, "s m"]


class ScreenedSPSRPosterior(TrigonometricPosterior):
    """The posterior p(g | D) under `ScreenedSPSR`, g = f - c, in closed form and as pathwise samples.

    - `level`: zero, because g is relative to the level.
    - `mean_coefficients`: coefficients of E g, see `surfaces/trigonometric.py`.
    - `base`: the posterior p(f | normals).
    - `rows`: the observed values.
    - `value_unit`: h, the unit of the values, see `ScreenedSPSR.offset`.
    - `whitened_cross`: C^-1 K_df, where A = C C^T is the covariance of the normals, and K_df their covariance with f at
      the points of `rows`.
    - `factor`: the Cholesky factor of S, the covariance of the values given the normals.
    - `weights`: the weights w of the values in the posterior mean.
    """

    level: Float[Array, ""]
    mean_coefficients: Float[Array, "a a a"]
    model: ScreenedSPSR
    base: GeometricSPSRPosterior
    rows: ValueRows
    value_unit: Float[Array, ""]
    whitened_cross: Float[Array, "3 n m"]
    factor: CholeskyFactor
    weights: Float[Array, " m"]

    @on_torus
    @program
    def variance(self, x: Float[AnyArray, "n 3"]) -> Float[Array, " n"]:
        x = jnp.asarray(x, dtype=self.weights.dtype)
        spectrum = self.model.base.spectrum
        prior = function_variance(spectrum) + self.model.level_deviation**2

        def at_point(point):
            # Whitened covariances of g with the normals, and with the observed values given the normals.
            normals = self.base.solver.whitened_cross(point[None])
            cross = function_covariance(self.rows.points, point[None], spectrum) + self.model.level_deviation**2
            cross = cross - jnp.einsum("dnm,dnx->mx", self.whitened_cross, normals, precision="highest")
            values = self.factor.whiten(jnp.where(self.rows.mask[:, None], cross, 0.0))
            return jnp.maximum(prior - jnp.sum(normals**2) - jnp.sum(values**2), 0.0)

        return jax.lax.map(at_point, x, batch_size=points_per_batch(len(x), self.base.cloud.capacity))

    def data_points(self) -> DataPoints:
        """Return where a mean function is evaluated: its gradient at the cloud's points, its value at `rows`."""
        return DataPoints(self.base.data_points().gradient_points, fill_rows(self.rows.points, self.rows.mask))

    def level_shift(self, means: MeansAtData) -> Float[Array, " s"]:
        """Return zero for each mean function, because g is relative to the level."""
        return jnp.zeros(len(means.values), self.weights.dtype)

    def prior_draws(self, key: PRNGKeyArray, num_samples: int) -> ScreenedDraws:
        """Draw the normal field, its noise, the level and the noise of the values."""
        base_key, level_key, noise_key = jax.random.split(key, 3)
        normals = self.base.prior_draws(base_key, num_samples)
        dtype, shape = normals.noisy_normals.dtype, self.rows.noise.shape
        level = self.model.level_deviation * jax.random.normal(level_key, (num_samples,), dtype)
        noise = self.value_unit * self.rows.noise * jax.random.normal(noise_key, (num_samples, *shape), dtype)
        return ScreenedDraws(normals, level, noise)

    def condition_draws(self, draws: ScreenedDraws, means: MeansAtData) -> Float[Array, "s a a a"]:
        """Return the coefficients of samples of g: the draws conditioned on normals, and then on values."""
        residual = self.base.whitened_residual(draws.normals, means)
        coefficients, level, noise = draws.normals.coefficients, draws.level, draws.noise
        transform = NonuniformTransform(self.rows.points, self.model.base.truncation)
        row_values = shared_map(_evaluate, coefficients, transform)
        # Condition f(Y) on the normals. Their residual r adds K_fd A^-1 r, which is a product of two whitened arrays.
        update = jnp.einsum("dnm,snd->sm", self.whitened_cross, residual, precision="highest")
        row_values = row_values + update + means.values
        weights = jax.vmap(self.solve)(self.value_unit * self.rows.values - row_values + level[:, None] - noise)
        return self._update_draws(coefficients, residual, -level, weights)

    def solve(self, residual: Float[Array, " m"]) -> Float[Array, " m"]:
        """Return S^-1 r for a residual r of the observed values, with zeros in unfilled rows."""
        return self.factor.solve(jnp.where(self.rows.mask, residual, 0.0))

    def _update_draws(
        self,
        coefficients: Float[Array, "s 3 a a a"],
        residual: Float[Array, "s n 3"],
        constant: Float[Array, " s"],
        weights: Float[Array, "s m"],
    ) -> Float[Array, "s a a a"]:
        """Return the coefficients of g for each sample.

        - `coefficients`, `constant`: coefficients of the drawn normal field, and minus the drawn level.
        - `residual`, `weights`: whitened residual of the normals, and the weights w of the values.
        """
        remainder = residual - jnp.einsum("dnm,sm->snd", self.whitened_cross, weights, precision="highest")
        fields = self.base.update_draws(coefficients, remainder)
        transform = NonuniformTransform(self.rows.points, self.model.base.truncation)
        variance = mode_variance(self.model.base.spectrum)
        value_part = shared_map(_reconstruct, weights, transform, variance)
        middle = fields.shape[-1] // 2
        constant = constant + self.model.level_deviation**2 * jnp.sum(weights, axis=1)
        return (fields - value_part).at[:, middle, middle, middle].add(constant)


def _evaluate(normals: Float[Array, "3 a a a"], transform: NonuniformTransform) -> Float[Array, " m"]:
    """Return the values of Poisson(v) at the points of the transform, for a normal field v."""
    return transform.evaluate(solve_poisson(normals)[None])[:, 0]


def _reconstruct(
    weights: Float[Array, " m"], transform: NonuniformTransform, variance: Float[Array, "a a a"]
) -> Float[Array, "a a a"]:
    """Return the coefficients of -cov(f, f(Y)) w, where Y are the transform's points, and w the weights."""
    return inverse_laplacian(variance * transform.adjoint(weights[:, None])[0])
