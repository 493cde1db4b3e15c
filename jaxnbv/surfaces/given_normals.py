"""What posteriors given oriented points share, whatever solves A w = n for them.

    mean     Poisson(k(., X) A^-1 n)
    sample   Poisson(v + k(., X) A^-1 (n - v(X) - eps)), v and eps from the prior

Names are those of `jaxnbv.surfaces.spsr`.
"""

from abc import abstractmethod
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.sharding import shared_map
from jaxnbv.surfaces.covariance import Spectra, mode_variance
from jaxnbv.surfaces.matern import Scalar
from jaxnbv.surfaces.nonuniform import NonuniformTransform
from jaxnbv.surfaces.pathwise import DataPoints, MeansAtData, TrigonometricPosterior, filled
from jaxnbv.surfaces.trigonometric import solve_poisson


class NormalDraws(NamedTuple):
    """v drawn from the prior, by its coefficients, and v(X) + eps."""

    coefficients: Float[Array, "s 3 a a a"]
    at_data: Float[Array, "s n 3"]


class NormalsPosterior(TrigonometricPosterior):
    """p(f | D) under `GeometricSPSR`.

    - `level`: mean over the data of E f(x_j); the surface is where f equals it.
    - `mean_coefficients`: of E f, see `surfaces/trigonometric.py`.
    - `cloud`: D, with zeros in the rows that are not filled.
    - `weights`: A^-1 n.
    - `spectrum`, `noise`: of the prior and of the normals.
    """

    level: Float[Array, ""]
    mean_coefficients: Float[Array, "a a a"]
    cloud: PointCloud
    weights: Float[Array, "n 3"]
    spectrum: Spectra
    noise: Scalar

    @property
    def truncation(self) -> int:
        """L."""
        return self.spectrum.shape[-1] - 1

    @abstractmethod
    def solve(self, rows: Float[Array, "s n 3"]) -> Float[Array, "s n 3"]:
        """A^-1 applied to the columns of each block; zero in rows that are not filled, where it is zero."""

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
        return self.reconstructed(draws.coefficients, self.solve(self.residual(draws, means)))

    def residual(self, draws: NormalDraws, means: MeansAtData) -> Float[Array, "s n 3"]:
        """n - grad m - v(X) - eps, zero in rows that are not filled."""
        return jnp.where(self.cloud.mask[:, None], self.cloud.normals - means.gradients - draws.at_data, 0.0)

    def reconstructed(
        self, coefficients: Float[Array, "s 3 a a a"], weights: Float[Array, "s n 3"]
    ) -> Float[Array, "s a a a"]:
        """Coefficients of Poisson(v + k(., X) w) for each v and each w."""
        transform = NonuniformTransform(self.cloud.points, self.truncation)

        def update(sample, transform, spectrum):
            coefficients, weights = sample
            return solve_poisson(coefficients) + reconstruct(transform, weights, spectrum)

        return shared_map(update, (coefficients, weights), transform, self.spectrum)


def reconstruct(
    transform: NonuniformTransform, weights: Float[Array, "n 3"], spectrum: Spectra
) -> Float[Array, "a a a"]:
    """Coefficients of the f that k(., X) weights reconstructs: its Laplacian is their divergence."""
    return solve_poisson(mode_variance(spectrum) * transform.adjoint(weights))


def cleared(cloud: PointCloud) -> PointCloud:
    """With zeros in the rows that are not filled: whatever stands there, NaN included, must not reach the products."""
    points, normals = (jnp.where(cloud.mask[:, None], rows, 0.0) for rows in (cloud.points, cloud.normals))
    return PointCloud(points, normals, cloud.mask)


def mean_of(
    weights: Float[Array, "n 3"], cloud: PointCloud, spectrum: Spectra
) -> tuple[Float[Array, ""], Float[Array, "a a a"]]:
    """The level, and the coefficients of E f, for weights A^-1 n."""
    transform = NonuniformTransform(cloud.points, spectrum.shape[-1] - 1)
    mean = reconstruct(transform, weights, spectrum)
    return mean_at_data(transform, mean, cloud), mean


def mean_at_data(
    transform: NonuniformTransform, coefficients: Float[Array, "a a a"], cloud: PointCloud
) -> Float[Array, ""]:
    """Mean of f over the filled rows of a cloud, the points of the transform."""
    at_data = transform.evaluate(coefficients[None])[:, 0]
    return jnp.sum(jnp.where(cloud.mask, at_data, 0.0)) / jnp.sum(cloud.mask)


@eqx.filter_jit
def _level_slope(posterior: NormalsPosterior) -> Float[Array, "n 3"]:
    """Derivative of the level with respect to the normals: A^-1 of that with respect to A^-1 n."""
    cloud, spectrum = posterior.cloud, posterior.spectrum
    transform = NonuniformTransform(cloud.points, posterior.truncation)

    def level(weights):
        return mean_at_data(transform, reconstruct(transform, weights, spectrum), cloud)

    return posterior.solve(jnp.where(cloud.mask[:, None], jax.grad(level)(posterior.weights), 0.0)[None])[0]
