"""What weights of the normals reconstruct: the f whose Laplacian is the divergence of k(., X) weights; its level."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Float

from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.surfaces.covariance import Spectra, mode_variance
from jaxnbv.surfaces.nonuniform import NonuniformTransform
from jaxnbv.surfaces.trigonometric import solve_poisson


def reconstruct(
    transform: NonuniformTransform, weights: Float[Array, "n 3"], spectrum: Spectra
) -> Float[Array, "a a a"]:
    """Coefficients of the f that k(., X) weights reconstructs."""
    return solve_poisson(mode_variance(spectrum) * transform.adjoint(weights))


def mean_at_data(
    transform: NonuniformTransform, coefficients: Float[Array, "a a a"], cloud: PointCloud
) -> Float[Array, ""]:
    """Mean of f over the filled rows of a cloud, the points of the transform."""
    at_data = transform.evaluate(coefficients[None])[:, 0]
    return jnp.sum(jnp.where(cloud.mask, at_data, 0.0)) / jnp.sum(cloud.mask)


@eqx.filter_jit
def level_slope(cloud: PointCloud, cholesky: Float[Array, "n n"], spectrum: Spectra) -> Float[Array, "n 3"]:
    """Derivative of the level with respect to the normals: it is linear in them.

    - `cholesky`: lower factor of A.
    """
    transform = NonuniformTransform(cloud.points, spectrum.shape[-1] - 1)

    def level(normals):
        weights = cho_solve((cholesky, True), normals)
        return mean_at_data(transform, reconstruct(transform, weights, spectrum), cloud)

    return jnp.where(cloud.mask[:, None], jax.grad(level)(cloud.normals), 0.0)
