"""Gaussian posteriors over band-limited functions: closed forms, and samples by pathwise conditioning.

A sample is a draw of the prior, moved by what the data say of the draw (Matheron's rule; Wilson et al. 2020). It can be
drawn about mean functions m_1, ..., m_S as well as about zero: the prior is then f_s = m_s + g, with g of mean zero,

    data     normals n_j - grad m_s(x_j) and values z_k - m_s(y_k), in place of n_j and z_k, are those of g
    scale    the draws of the prior and of the noise are multiplied by rho_s: what the data say of the mean stays, the
             covariance is rho_s^2 times the posterior's
    sample   f_s = m_s + g_s

The covariances are those of g, so all means share one factorisation, and each adds a right-hand side.
"""

from abc import abstractmethod
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from jaxnbv.checks import AnyArray, as_floats, check_key, checked, is_traced, require
from jaxnbv.surfaces.base import Fields, SurfacePosterior, on_grid_of_torus, on_torus, sampling_method
from jaxnbv.surfaces.trigonometric import TrigonometricFields


class MeansAtData(NamedTuple):
    """What mean functions are where the posterior has data: their gradients at its normals, and their values."""

    gradients: Float[Array, "s n 3"]
    values: Float[Array, "s m"]


class DataPoints(NamedTuple):
    """Where a posterior asks mean functions for their gradients and for their values."""

    gradients: Float[Array, "n 3"]
    values: Float[Array, "m 3"]


class FieldsAbout(Fields):
    """f_s = m_s + r_s: samples about mean functions.

    - `means`: m_1, ..., m_S.
    - `residual`: r_1, ..., r_S.
    """

    means: Fields
    residual: TrigonometricFields

    def __call__(self, x: Float[AnyArray, "n 3"]) -> Float[Array, "s n"]:
        return self.means(x) + self.residual(x)

    def gradient(self, x: Float[AnyArray, "n 3"]) -> Float[Array, "s n 3"]:
        return self.means.gradient(x) + self.residual.gradient(x)

    def on_grid(self, axis: Float[AnyArray, " g"]) -> Float[Array, "s g g g"]:
        return self.means.on_grid(axis) + self.residual.on_grid(axis)


class TrigonometricPosterior(SurfacePosterior):
    """A Gaussian posterior whose prior, and so whose mean and samples about zero, are band-limited functions.

    - `mean_coefficients`: of E f.
    """

    mean_coefficients: eqx.AbstractVar[Float[Array, "a a a"]]

    @property
    def mean_field(self) -> TrigonometricFields:
        """E f as a single field."""
        return TrigonometricFields(self.mean_coefficients[None])

    @on_torus
    @eqx.filter_jit
    def mean(self, x: Float[AnyArray, "n 3"]) -> Float[Array, " n"]:
        return self.mean_field(x)[0]

    @on_grid_of_torus
    @eqx.filter_jit
    def mean_on_grid(self, axis: Float[AnyArray, " g"]) -> Float[Array, "g g g"]:
        return self.mean_field.on_grid(axis)[0]

    @abstractmethod
    def variance(self, x: Float[AnyArray, "n 3"]) -> Float[Array, " n"]: ...

    @on_torus
    @eqx.filter_jit
    def probability_inside(self, x: Float[AnyArray, "n 3"]) -> Float[Array, " n"]:
        """P(f(x) < level) = Phi((level - E f(x)) / sqrt(Var f(x))) at points in scene coordinates. As costly as the
        variance."""
        variance = self.variance(x)
        deviation = jnp.sqrt(jnp.maximum(variance, jnp.finfo(variance.dtype).tiny))
        return norm.cdf((self.level - self.mean(x)) / deviation)

    @sampling_method
    def sample(self, key: PRNGKeyArray, num_samples: int) -> TrigonometricFields:
        """`num_samples` joint samples of f by pathwise conditioning: functions, to be evaluated anywhere."""
        about_zero = _at_data(_Zeros(num_samples), self.data_points())
        return TrigonometricFields(_sampled(self, key, about_zero, None))

    @checked
    def sample_about(
        self, means: Fields, key: PRNGKeyArray, noise_scale: float | int | Float[AnyArray, "*s"] = 1.0
    ) -> FieldsAbout:
        """One sample of f about each of S mean functions: m_s + g_s, with the prior's g given normals n - grad m_s and
        values less those of m_s. With a mean of zero it is that of `sample` under the same key.

        The samples are relative to the level of this posterior, whatever that of the mean is: a surface is where
        `fields(x) == posterior.level`.

        - `means`: any functions, differentiable once.
        - `noise_scale`: rho, one number or one for each mean function. The samples' deviation from their mean is rho
          times that of the posterior; 0 gives E f about each m_s, whatever the key.

        **Raises:** `ValueError` for means that are no `Fields`, a noise scale that is negative or not finite, another
        number of them than of mean functions, or means that are not finite at the data.
        """
        check_key(key)
        at_data = _at_data(means, self.data_points())
        scale = as_floats(noise_scale, "the noise scale").astype(self.mean_coefficients.dtype)
        count = len(at_data.values)
        require(
            scale.shape in ((), (count,)),
            f"the noise scale has shape {scale.shape}, but there are {count} mean functions: give one number, or one "
            "for each",
        )
        if not is_traced(scale):
            least, most = float(np.min(scale)), float(np.max(scale))
            require(least >= 0, f"a noise scale is {least:.4g}; it must not be negative")
            require(most < np.inf, f"a noise scale is {most:.4g}; it must be finite")
        unscaled = not is_traced(scale) and least == most == 1.0
        coefficients = _sampled(self, key, at_data, None if unscaled else scale)
        levels = self.level_about(at_data)
        if not is_traced(levels, coefficients):
            finite = jnp.isfinite(coefficients).all(axis=(1, 2, 3)) & jnp.isfinite(levels)
            bad = np.flatnonzero(~np.asarray(finite))
            require(
                bad.size == 0,
                f"{bad.size} of the {count} mean functions, the first of them number {bad[:1]}, have values or "
                "gradients at the data that are not finite",
            )
        middle = coefficients.shape[-1] // 2
        return FieldsAbout(means, TrigonometricFields(coefficients.at[:, middle, middle, middle].add(-levels)))

    @abstractmethod
    def data_points(self) -> DataPoints:
        """Where mean functions are asked for their gradients and values."""

    @abstractmethod
    def level_about(self, means: MeansAtData) -> Float[Array, " s"]:
        """How much higher the level is about mean functions than about zero."""

    @abstractmethod
    def prior_draws(self, key: PRNGKeyArray, num_samples: int) -> Any:
        """Draws of the prior and of the noise of the data: arrays of mean zero, with a leading axis of samples."""

    @abstractmethod
    def conditioned(self, draws: Any, means: MeansAtData) -> Float[Array, "s a a a"]:
        """Coefficients of the draws, given the data less the means: jointly linear in draws, data and means."""


class _Zeros(Fields):
    """The mean functions of a prior about zero."""

    count: int = eqx.field(static=True)

    def __call__(self, x: Float[AnyArray, "n 3"]) -> Float[Array, "s n"]:
        return jnp.zeros((self.count, len(x)), jnp.asarray(x).dtype)

    def gradient(self, x: Float[AnyArray, "n 3"]) -> Float[Array, "s n 3"]:
        return jnp.zeros((self.count, *x.shape), jnp.asarray(x).dtype)


def filled(points: Float[Array, "n 3"], mask: Bool[Array, " n"]) -> Float[Array, "n 3"]:
    """The points with the first one that holds something in place of those that hold nothing: zeros stand there, where
    a mean function may have no gradient, and its derivatives would not be finite though they count for nothing."""
    return jnp.where(mask[:, None], points, points[jnp.argmax(mask)])


# One program each for samples about zero and about means, so that they are the same to the last digit.


@eqx.filter_jit
def _at_data(means: Fields, points: DataPoints) -> MeansAtData:
    dtype, count = points.gradients.dtype, len(points.values)
    values = means(points.values)
    require(
        values.ndim == 2 and values.shape[1] == count,
        f"the mean functions give values {values.shape} at {count} points: Fields give one row for each function",
    )
    return MeansAtData(means.gradient(points.gradients).astype(dtype), values.astype(dtype))


@eqx.filter_jit
def _sampled(
    posterior: TrigonometricPosterior, key: PRNGKeyArray, means: MeansAtData, scale: Float[Array, "*s"] | None
) -> Float[Array, "s a a a"]:
    draws = posterior.prior_draws(key, len(means.values))
    # A product by one would change how the sums it stands in are rounded.
    if scale is not None:
        draws = jax.tree.map(lambda draw: draw * scale.reshape(-1, *(1,) * (draw.ndim - 1)), draws)
    return posterior.conditioned(draws, means)
