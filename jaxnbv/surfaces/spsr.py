"""Geometric stochastic Poisson reconstruction (Holalkere et al. 2025), exact for the truncated prior.

    prior    v_1, v_2, v_3 independent Gaussian processes on the torus of period 2 pi, with the covariance function
             k(x, y) = sum_{|m|_inf <= L} s(m) cos(m.(x - y)),   s(m) = s1(m_1) s1(m_2) s1(m_3),
             or a sum of such s, one for each lengthscale
    Poisson  f_hat(m) = -i m . v_hat(m) / |m|^2,   f_hat(0) = 0
    data     n_j = v(x_j) + eps_j,   eps_j ~ N(0, noise^2 I),   A = k(X, X) + noise^2 I
    sample   v_post = v + k(., X) A^-1 (n - v(X) - eps), v and eps from the prior;   f = Poisson(v_post)

Here m is an integer frequency vector, s1 the Matern spectrum on the circle, and L the truncation. X are the observed
points, and n are their normals. All terms of a sample use the same draws of v and eps (Matheron's rule; Wilson et al.
2020), so samples have exactly the posterior's distribution.
"""

import functools
import math
import warnings
from typing import TYPE_CHECKING, Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial import cKDTree

from jaxnbv.checks import as_floats, check_type, is_traced, own_settings, require
from jaxnbv.geometry.cloud import PointCloud, check_oriented
from jaxnbv.observations import Observations, as_observations
from jaxnbv.programs import program
from jaxnbv.surfaces.base import HALF_WIDTH, SurfaceModel
from jaxnbv.surfaces.covariance import Scalar, Spectra, circle_spectrum
from jaxnbv.surfaces.given_normals import GeometricSPSRPosterior, condition_on_normals
from jaxnbv.surfaces.trigonometric import basis_variance

_MAX_SPACING = 2.5

# The converter also accepts numbers and tuples, which mypy cannot see.
if TYPE_CHECKING:
    Scales: TypeAlias = Any
else:
    Scales = Float[Array, "*scales"]


def _to_float(value) -> Float[Array, "*scales"]:
    return as_floats(value, "a hyperparameter")


class GeometricSPSR(SurfaceModel):
    """Matern prior on the normal field v over the torus, with f as its Poisson reconstruction.

    - `lengthscale`: ell, in units of the circumference 2 pi: 0.005 is 0.031 in scene units. With several lengthscales,
      the prior is a sum of independent priors: short ones for detail, and long ones for the overall shape.
    - `variance`: variance per axis, one for each lengthscale. Without truncation, Var v_d = variance^3 for each d.
    - `noise`: standard deviation of each component of the observed normals.
    - `nu`: smoothness, 1/2, 3/2 or 5/2.
    - `truncation`: L, the largest frequency along each axis. Frequencies up to L hold the fraction `kept_variance` of
      the prior's variance, 49 % for the defaults. The defaults are the paper's values.

    `lengthscale`, `variance` and `noise` are array leaves, so the posterior is differentiable in them.

    **Raises:** `ValueError` for values that are not positive, or for any other `nu`. Warns if less than a third of the
    variance is kept.
    """

    lengthscale: Scales = eqx.field(converter=_to_float, default=0.005)
    variance: Scales = eqx.field(converter=_to_float, default=0.2)
    truncation: int = eqx.field(static=True, default=50)
    noise: Scalar = eqx.field(converter=_to_float, default=0.01)
    nu: float = eqx.field(static=True, default=1.5)

    @own_settings()
    def __check_init__(self):
        check_type(self.nu, float, "nu")
        require(self.nu in (0.5, 1.5, 2.5), f"nu is {self.nu}; it must be 0.5, 1.5 or 2.5")
        check_type(self.truncation, int, "the truncation")
        require(self.truncation >= 1, f"the truncation is {self.truncation}; it must be a whole number, at least 1")
        shapes = jnp.shape(self.lengthscale), jnp.shape(self.variance)
        require(
            shapes[0] == shapes[1] and len(shapes[0]) <= 1 and jnp.size(self.lengthscale) >= 1,
            f"lengthscale and variance have shapes {shapes[0]} and {shapes[1]}: give one number each, or as many "
            "variances as lengthscales",
        )
        if is_traced(self.lengthscale, self.variance, self.noise):
            return
        for name in ("lengthscale", "variance", "noise"):
            value = np.asarray(getattr(self, name))
            is_positive = bool(np.all((value > 0) & (value < math.inf)))
            require(is_positive, f"{name} is {value}; it must be positive and finite")
        fraction = float(self.kept_variance)
        if fraction < 1 / 3:
            warnings.warn(
                f"truncation={self.truncation} keeps {fraction:.0%} of the prior's variance at "
                f"lengthscale={np.asarray(self.lengthscale)}: raise the truncation or the lengthscale",
                stacklevel=3,
            )

    @property
    def spectrum(self) -> Spectra:
        """Matern spectrum of one axis at frequencies 0, ..., L, with a leading axis for several lengthscales."""
        spectrum_of_scale = functools.partial(circle_spectrum, self.nu, truncation=self.truncation)
        if jnp.ndim(self.lengthscale) == 0:
            return spectrum_of_scale(self.lengthscale, self.variance)
        return jax.vmap(spectrum_of_scale)(self.lengthscale, self.variance)

    @property
    def kept_variance(self) -> Float[Array, ""]:
        """Fraction of the prior's variance at frequencies up to L, in three dimensions."""
        return _kept_variance(self)

    def check(self, cloud: PointCloud) -> None:
        """Warn if the median distance between neighbouring points exceeds 2.5 times the longest lengthscale.

        Then the data hardly constrain the samples: at the data, the posterior standard deviation of f minus its level
        is at least 0.9 times the prior standard deviation.
        """
        points, _ = cloud.to_numpy()
        if len(points) < 2 or is_traced(self):
            return
        spacing = float(np.median(cKDTree(points).query(points, k=2)[0][:, 1]))
        lengthscale = 2.0 * math.pi * float(np.max(self.lengthscale))
        if spacing > _MAX_SPACING * lengthscale:
            warnings.warn(
                f"points are {spacing:.2g} apart, {spacing / lengthscale:.1f} times the model's longest lengthscale of "
                f"{lengthscale:.2g} (scene units): samples hardly follow them. Scan more densely, or raise the "
                "lengthscale",
                stacklevel=2,
            )

    def condition(self, observations: Observations | PointCloud) -> GeometricSPSRPosterior:
        """Return the posterior p(f | D), given only the cloud of the observations.

        The cost is one Cholesky factorisation of a matrix with a row for each row of the cloud. Above a capacity of
        16,384 points, the cost is a few hundred transforms per solve.

        **Raises:** `ValueError` if the cloud is empty, has entries that are not finite, a normal longer than 10 or
        points outside [-pi/2, pi/2]^3 (scene coordinates), or if the covariance of the normals is singular in the
        dtype's precision. Under `jit` values cannot be checked, and points outside make the posterior NaN.
        """
        cloud = as_observations(observations).cloud
        if not is_traced(cloud):
            check_oriented(cloud, "the cloud", HALF_WIDTH, unit=False)
        posterior = condition_on_normals(cloud, self.spectrum, self.noise)
        if not is_traced(posterior.level):
            require(
                bool(jnp.isfinite(posterior.level)),
                f"the covariance of {int(cloud.count)} normals with noise={float(self.noise):.3g} is singular in "
                f"{posterior.level.dtype}: raise the noise, or enable jax_enable_x64",
            )
        return posterior


@program
def _kept_variance(model: GeometricSPSR) -> Float[Array, ""]:
    axis_variances = jnp.sum(jax.vmap(basis_variance)(jnp.atleast_2d(model.spectrum))[:, model.truncation :], axis=1)
    return jnp.sum(axis_variances**3) / jnp.sum(model.variance**3)
