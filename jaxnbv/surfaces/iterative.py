"""The posterior of `GeometricSPSR` for clouds that are too large to factorise A: A^-1 by conjugate gradients.

    A = Phi S Phi^T + noise^2 I,   Phi: the basis at the data,   S: the variances of the modes

A is never made: a product with it is a transform to coefficients and back. A solve for 50,000 points with L = 50 takes
about 200 products; a preconditioner by Cholesky factors of 512 or 1,024 neighbours each saved none.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array, Float

from jaxnbv.checks import AnyArray
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.sharding import shared_map
from jaxnbv.surfaces.base import on_torus
from jaxnbv.surfaces.covariance import Spectra, function_normal_covariance, function_variance, mode_variance
from jaxnbv.surfaces.given_normals import NormalsPosterior
from jaxnbv.surfaces.matern import Scalar
from jaxnbv.surfaces.nonuniform import NonuniformTransform

MOST_FACTORISED = 16384
"""The capacity up to which A is factorised: 1.1 GB in float32, and as much again while it is."""

_MOST_PRODUCTS = 2000


class IterativePosterior(NormalsPosterior):
    """p(f | D) under `GeometricSPSR` for more points than are factorised. Samples and means are as exact as the
    transforms, 1e-4 of the largest value in float32; what needs a determinant is not offered."""

    @on_torus
    @eqx.filter_jit
    def variance(self, x: Float[AnyArray, "n 3"]) -> Float[Array, " n"]:
        """Var f(x) at points in scene coordinates: a solve each."""
        x, prior = jnp.asarray(x, dtype=self.weights.dtype), function_variance(self.spectrum)

        def at_point(point):
            cross = function_normal_covariance(point[None], self.cloud.points, self.spectrum)[:, 0].T
            cross = jnp.where(self.cloud.mask[:, None], cross, 0.0)
            return jnp.maximum(prior - jnp.sum(cross * self.solve(cross[None])[0]), 0.0)

        return jax.lax.map(at_point, x)

    def solve(self, rows: Float[Array, "s n 3"]) -> Float[Array, "s n 3"]:
        """A^-1 applied to the columns of each block."""
        return by_conjugate_gradients(rows, self.cloud, self.spectrum, self.noise)


def by_conjugate_gradients(
    rows: Float[Array, "s n 3"], cloud: PointCloud, spectrum: Spectra, noise: Scalar
) -> Float[Array, "s n 3"]:
    """A^-1 applied to the columns of each block, which are zero in rows that are not filled; NaN where that did not
    converge."""
    tolerance = float(jnp.finfo(rows.dtype).eps) ** 0.8

    def solved(rows, transform, variance, noise, mask):
        def product(rows):
            return jnp.where(mask, transform.evaluate(variance * transform.adjoint(rows)), 0.0) + noise**2 * rows

        found, _ = cg(product, rows, tol=tolerance, maxiter=_MOST_PRODUCTS)
        left = jnp.linalg.norm(rows - product(found)) / jnp.linalg.norm(rows)
        return jnp.where(left < 10 * tolerance, found, jnp.nan)

    transform = NonuniformTransform(cloud.points, spectrum.shape[-1] - 1)
    return shared_map(solved, rows, transform, mode_variance(spectrum), noise, cloud.mask[:, None])
