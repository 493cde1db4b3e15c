"""The posterior p(f | D) under `GeometricSPSR`: closed forms, and pathwise samples.

    solver   A^-1 for A = k(X, X) + noise^2 I, see `surfaces/solver.py`
    mean     Poisson(k(., X) A^-1 n)
    sample   Poisson(v + k(., X) A^-1 (n - v(X) - eps)), v and eps from the prior

X are the points of D, n their normals, v the normal field with prior covariance k, and eps the noise of the normals.
`jaxnbv.surfaces.spsr` defines the prior and Poisson.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from jaxnbv.checks import AnyArray
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.programs import program
from jaxnbv.sharding import shared_map
from jaxnbv.surfaces.base import on_torus
from jaxnbv.surfaces.covariance import Scalar, Spectra, function_covariance, function_variance, mode_variance
from jaxnbv.surfaces.pathwise import DataPoints, MeansAtData, TrigonometricPosterior, fill_rows
from jaxnbv.surfaces.solver import Solver, solver_of
from jaxnbv.surfaces.trigonometric import NonuniformTransform, solve_poisson


class NormalDraws(NamedTuple):
    """Prior draws: coefficients of the normal field v, and v(X) plus noise at the cloud's points X."""

    coefficients: Float[Array, "s 3 a a a"]
    noisy_normals: Float[Array, "s n 3"]


class GeometricSPSRPosterior(TrigonometricPosterior):
    """The posterior p(f | D) under `GeometricSPSR`, in closed form and as pathwise samples.

    - `level`: mean of E f(x_j) over the points x_j of D.
    - `mean_coefficients`: coefficients of E f, see `surfaces/trigonometric.py`.
    - `weights`: A^-1 n, where n are the observed normals and A is their covariance.
    - `solver`: applies A^-1, and has the cloud, spectrum and noise that define A. For a capacity above 16,384 points it
      uses conjugate gradients, and then `covariance` and `log_marginal_likelihood` raise `ValueError`.
    """

    level: Float[Array, ""]
    mean_coefficients: Float[Array, "a a a"]
    weights: Float[Array, "n 3"]
    solver: Solver

    @property
    def cloud(self) -> PointCloud:
        """The cloud D, with zeros in unfilled rows."""
        return self.solver.cloud

    @property
    def spectrum(self) -> Spectra:
        """The spectrum of the prior."""
        return self.solver.spectrum

    @property
    def truncation(self) -> int:
        """L, the largest frequency along each axis."""
        return self.spectrum.shape[-1] - 1

    @on_torus
    @program
    def variance(self, x: Float[AnyArray, "n 3"]) -> Float[Array, " n"]:
        """Return Var f(x), the prior variance minus what the data explain, at points in scene coordinates."""
        x = jnp.asarray(x, dtype=self.weights.dtype)
        return jnp.maximum(function_variance(self.spectrum) - self.solver.explained_variance(x), 0.0)

    @on_torus
    @program
    def covariance(self, x: Float[AnyArray, "n 3"], y: Float[AnyArray, "m 3"]) -> Float[Array, "n m"]:
        """Return the posterior Cov(f(x), f(y)) of all pairs of points (scene coordinates), computed at once."""
        x, y = (jnp.asarray(points, dtype=self.weights.dtype) for points in (x, y))
        explained = jnp.einsum("djn,djm->nm", *map(self.solver.whitened_cross, (x, y)), precision="highest")
        return function_covariance(x, y, self.spectrum) - explained

    def log_marginal_likelihood(self) -> Float[Array, ""]:
        """Return log p(normals | points) of the cloud, summed over the three components of the normals."""
        count = self.cloud.count
        fit = jnp.sum(self.cloud.normals * self.weights)
        return -0.5 * (fit + 3.0 * self.solver.factor.log_determinant + 3.0 * count * jnp.log(2.0 * jnp.pi))

    def data_points(self) -> DataPoints:
        """Return the cloud's points twice: `sample_about` needs gradients and values at all of them."""
        points = fill_rows(self.cloud.points, self.cloud.mask)
        return DataPoints(points, points)

    def level_shift(self, means: MeansAtData) -> Float[Array, " s"]:
        """Return the change of the level that each mean function m_s causes.

        It is the mean of m_s(x_j) over the data, minus the level of a posterior with the normals grad m_s(x_j). The
        level is linear in the normals, so its slope is computed once for all mean functions.
        """
        explained = jnp.einsum("snd,nd->s", means.gradients, _level_slope(self), precision="highest")
        return jnp.mean(means.values, axis=1, where=self.cloud.mask) - explained

    def prior_draws(self, key: PRNGKeyArray, num_samples: int) -> NormalDraws:
        """Draw the normal field v, and v(X) plus noise at the cloud's points X, for each sample."""
        scale, dtype = jnp.sqrt(mode_variance(self.spectrum)), self.weights.dtype
        modes, shape = scale.shape[0], self.cloud.points.shape
        transform = NonuniformTransform(self.cloud.points, self.truncation)
        field_keys, noise_keys = jax.random.split(key, (2, num_samples))

        def prior(keys, scale, deviation, transform):
            field_key, noise_key = keys
            coefficients = scale * jax.random.normal(field_key, (3, modes, modes, modes), dtype)
            noise = deviation * jax.random.normal(noise_key, shape, dtype)
            return NormalDraws(coefficients, transform.evaluate(coefficients) + noise)

        return shared_map(prior, (field_keys, noise_keys), scale, self.solver.noise, transform)

    def condition_draws(self, draws: NormalDraws, means: MeansAtData) -> Float[Array, "s a a a"]:
        """Condition the draws on the normals, and return the coefficients of the samples.

        A sample is Poisson(v + k(., X) A^-1 (n - grad m(X) - v(X) - eps)), where m is its mean function.
        """
        return self._reconstruct_samples(draws.coefficients, self.solver.solve(self._residual(draws, means)))

    def _residual(self, draws: NormalDraws, means: MeansAtData) -> Float[Array, "s n 3"]:
        return jnp.where(self.cloud.mask[:, None], self.cloud.normals - means.gradients - draws.noisy_normals, 0.0)

    def whitened_residual(self, draws: NormalDraws, means: MeansAtData) -> Float[Array, "s n 3"]:
        """Return C^-1 (n - grad m(X) - v(X) - eps) for each sample, where A = C C^T is the covariance of n."""
        return self.solver.whiten(self._residual(draws, means))

    def update_draws(
        self, coefficients: Float[Array, "s 3 a a a"], residual: Float[Array, "s n 3"]
    ) -> Float[Array, "s a a a"]:
        """Return the coefficients of Poisson(v + k(., X) C^-T z) for normal fields v and whitened residuals z."""
        return self._reconstruct_samples(coefficients, self.solver.unwhiten(residual))

    def _reconstruct_samples(
        self, coefficients: Float[Array, "s 3 a a a"], weights: Float[Array, "s n 3"]
    ) -> Float[Array, "s a a a"]:
        transform = NonuniformTransform(self.cloud.points, self.truncation)

        def update(sample, transform, spectrum):
            coefficients, weights = sample
            return solve_poisson(coefficients) + reconstruct(transform, weights, spectrum)

        return shared_map(update, (coefficients, weights), transform, self.spectrum)


@program
def condition_on_normals(cloud: PointCloud, spectrum: Spectra, noise: Scalar) -> GeometricSPSRPosterior:
    """Return the posterior p(f | D), with a solver that suits the cloud's capacity."""
    # Unfilled rows may hold NaN. Set them to zero, because NaN would spread through products.
    points, normals = (jnp.where(cloud.mask[:, None], rows, 0.0) for rows in (cloud.points, cloud.normals))
    cloud = PointCloud(points, normals, cloud.mask)
    solver = solver_of(cloud, spectrum, noise)
    weights = solver.solve(normals[None])[0]
    transform = NonuniformTransform(cloud.points, spectrum.shape[-1] - 1)
    mean = reconstruct(transform, weights, spectrum)
    level = mean_at_data(transform, mean, cloud)
    return GeometricSPSRPosterior(level, mean, weights, solver)


def reconstruct(
    transform: NonuniformTransform, weights: Float[Array, "n 3"], spectrum: Spectra
) -> Float[Array, "a a a"]:
    """Return the coefficients of Poisson(k(., X) w), with weights w and the points X of the transform."""
    return solve_poisson(mode_variance(spectrum) * transform.adjoint(weights))


def mean_at_data(
    transform: NonuniformTransform, coefficients: Float[Array, "a a a"], cloud: PointCloud
) -> Float[Array, ""]:
    """Return a function's mean over the filled rows of a cloud, whose points are those of the transform."""
    values = transform.evaluate(coefficients[None])[:, 0]
    return jnp.sum(jnp.where(cloud.mask, values, 0.0)) / jnp.sum(cloud.mask)


@program
def _level_slope(posterior: GeometricSPSRPosterior) -> Float[Array, "n 3"]:
    """Return the derivative of the level with respect to the normals n.

    It is A^-1 times the derivative with respect to the weights A^-1 n, where A is the covariance of n.
    """
    cloud, spectrum = posterior.cloud, posterior.spectrum
    transform = NonuniformTransform(cloud.points, posterior.truncation)

    def damped(fields):
        return solve_poisson(mode_variance(spectrum) * fields)

    # `adjoint` and `evaluate` are transposes of each other, and ten times as fast as the transposes that JAX derives.
    coefficients = transform.adjoint(cloud.mask[:, None] / jnp.sum(cloud.mask))[0]
    fields = jax.ShapeDtypeStruct((3, *coefficients.shape), coefficients.dtype)
    slope = transform.evaluate(jax.linear_transpose(damped, fields)(coefficients)[0])
    return posterior.solver.solve(jnp.where(cloud.mask[:, None], slope, 0.0)[None])[0]
