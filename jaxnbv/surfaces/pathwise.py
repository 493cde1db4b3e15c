"""Gaussian posteriors over band-limited functions: closed forms, and samples by pathwise conditioning.

A sample is a draw of the prior plus a correction at the data (Matheron's rule; Wilson et al. 2020). The data are
normals n_j at points x_j and values z_k of f at points y_k. The prior mean may be zero, or a function m_s for each
sample s = 1, ..., S. Then f_s = m_s + g, with g of prior mean zero:

    data     g is conditioned on n_j - grad m_s(x_j) and z_k - m_s(y_k), in place of n_j and z_k
    scale    the draws of g and of the noise are multiplied by the noise scale rho_s. This keeps the posterior mean,
             and multiplies the posterior covariance by rho_s^2
    sample   f_s = m_s + g_s, where g_s is a sample of g

The covariances do not depend on m_s. So all samples share one factorisation, and each m_s adds one right-hand side.
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
from jaxnbv.programs import program
from jaxnbv.surfaces.base import Fields, SurfacePosterior, on_grid_of_torus, on_torus, sampling_method
from jaxnbv.surfaces.trigonometric import TrigonometricFields


class MeansAtData(NamedTuple):
    """Gradients and values of mean functions at the `DataPoints` of a posterior."""

    gradients: Float[Array, "s n 3"]
    values: Float[Array, "s m"]


class DataPoints(NamedTuple):
    """The points at which `sample_about` evaluates mean functions.

    - `gradient_points`: the points of the observed normals, where it needs gradients.
    - `value_points`: the points of the observed values of f, or those that define the level, where it needs values.
    """

    gradient_points: Float[Array, "n 3"]
    value_points: Float[Array, "m 3"]


class FieldsAbout(Fields):
    """Samples f_s = m_s + r_s, with mean functions m_s (`means`) and differences r_s (`residual`)."""

    means: Fields
    residual: TrigonometricFields

    def __call__(self, x: Float[AnyArray, "n 3"]) -> Float[Array, "s n"]:
        return self.means(x) + self.residual(x)

    def gradient(self, x: Float[AnyArray, "n 3"]) -> Float[Array, "s n 3"]:
        return self.means.gradient(x) + self.residual.gradient(x)

    def on_grid(self, axis: Float[AnyArray, " g"]) -> Float[Array, "s g g g"]:
        return self.means.on_grid(axis) + self.residual.on_grid(axis)


class TrigonometricPosterior(SurfacePosterior):
    """A Gaussian posterior with a band-limited prior, whose mean and samples are band-limited too.

    - `mean_coefficients`: coefficients of E f in the basis of `surfaces/trigonometric.py`.
    """

    mean_coefficients: eqx.AbstractVar[Float[Array, "a a a"]]

    @property
    def mean_field(self) -> TrigonometricFields:
        """The posterior mean E f, as a batch of one field."""
        return TrigonometricFields(self.mean_coefficients[None])

    @on_torus
    @program
    def mean(self, x: Float[AnyArray, "n 3"]) -> Float[Array, " n"]:
        return self.mean_field(x)[0]

    @on_grid_of_torus
    @program
    def mean_on_grid(self, axis: Float[AnyArray, " g"]) -> Float[Array, "g g g"]:
        return self.mean_field.on_grid(axis)[0]

    @abstractmethod
    def variance(self, x: Float[AnyArray, "n 3"]) -> Float[Array, " n"]: ...

    @on_torus
    @program
    def probability_inside(self, x: Float[AnyArray, "n 3"]) -> Float[Array, " n"]:
        """Return P(f(x) < level) = Phi((level - E f(x)) / sqrt(Var f(x))) at points in scene coordinates."""
        variance = self.variance(x)
        deviation = jnp.sqrt(jnp.maximum(variance, jnp.finfo(variance.dtype).tiny))
        return norm.cdf((self.level - self.mean(x)) / deviation)

    @sampling_method
    def sample(self, key: PRNGKeyArray, num_samples: int) -> TrigonometricFields:
        """Draw `num_samples` samples of the function f by pathwise conditioning."""
        means = _evaluate_means(_Zeros(num_samples), self.data_points())
        return TrigonometricFields(_sample_coefficients(self, key, means, None))

    @checked
    def sample_about(
        self, means: Fields, key: PRNGKeyArray, noise_scale: float | int | Float[AnyArray, "*s"] = 1.0
    ) -> FieldsAbout:
        """Draw one sample m_s + g_s of f about each of S mean functions.

        g_s is a sample of the posterior given the observed normals minus grad m_s, and the observed values minus m_s.
        If all mean functions are zero, the result equals that of `sample` with this key. The surface of a sample is
        where its field equals `level`.

        - `means`: the mean functions m_s, which must be differentiable once.
        - `noise_scale`: factor on the deviation of samples from the posterior mean, one number or one for each mean
          function. With 0, each sample is the posterior mean for its m_s.

        **Raises:** `ValueError` for means that are not `Fields`, a noise scale that is negative or not finite, a number
        of noise scales that differs from the number of mean functions, or means that are not finite at the data.
        """
        check_key(key)
        means_at_data = _evaluate_means(means, self.data_points())
        scale = as_floats(noise_scale, "the noise scale").astype(self.mean_coefficients.dtype)
        count = len(means_at_data.values)
        require(
            scale.shape in ((), (count,)),
            f"the noise scale has shape {scale.shape}, but there are {count} mean functions: give one number, or one "
            "for each",
        )
        if not is_traced(scale):
            smallest, largest = float(np.min(scale)), float(np.max(scale))
            require(smallest >= 0, f"a noise scale is {smallest:.4g}; it must not be negative")
            require(largest < np.inf, f"a noise scale is {largest:.4g}; it must be finite")
        is_unscaled = not is_traced(scale) and smallest == largest == 1.0
        coefficients = _sample_coefficients(self, key, means_at_data, None if is_unscaled else scale)
        levels = self.level_shift(means_at_data)
        if not is_traced(levels, coefficients):
            is_finite = jnp.isfinite(coefficients).all(axis=(1, 2, 3)) & jnp.isfinite(levels)
            bad = np.flatnonzero(~np.asarray(is_finite))
            require(
                bad.size == 0,
                f"{bad.size} of the {count} mean functions, the first of them number {bad[:1]}, have values or "
                "gradients at the data that are not finite",
            )
        middle = coefficients.shape[-1] // 2
        return FieldsAbout(means, TrigonometricFields(coefficients.at[:, middle, middle, middle].add(-levels)))

    @abstractmethod
    def data_points(self) -> DataPoints:
        """Return the points at which `sample_about` needs gradients and values of mean functions."""

    @abstractmethod
    def level_shift(self, means: MeansAtData) -> Float[Array, " s"]:
        """Return, for each mean function, the level of samples with this mean minus `level`."""

    @abstractmethod
    def prior_draws(self, key: PRNGKeyArray, num_samples: int) -> Any:
        """Draw from the prior and the noise of the data: arrays of mean zero, with samples along axis 0."""

    @abstractmethod
    def condition_draws(self, draws: Any, means: MeansAtData) -> Float[Array, "s a a a"]:
        """Condition the draws on the data minus the means, and return the coefficients of the samples.

        The coefficients are those of g_s, without m_s. They are jointly linear in the draws, the data and the means.
        """


class _Zeros(Fields):
    count: int = eqx.field(static=True)

    def __call__(self, x: Float[AnyArray, "n 3"]) -> Float[Array, "s n"]:
        return jnp.zeros((self.count, len(x)), jnp.asarray(x).dtype)


def fill_rows(points: Float[Array, "n 3"], mask: Bool[Array, " n"]) -> Float[Array, "n 3"]:
    """Return the points with the first filled row copied into all unfilled rows.

    Unfilled rows hold the origin, where a mean function may have no gradient. Derivatives would then not be finite,
    although these rows are masked.
    """
    return jnp.where(mask[:, None], points, points[jnp.argmax(mask)])


# `sample` and `sample_about` run the same two programs, so that samples about zero equal `sample` bit for bit.


@program
def _evaluate_means(means: Fields, points: DataPoints) -> MeansAtData:
    dtype, count = points.gradient_points.dtype, len(points.value_points)
    values = means(points.value_points)
    require(
        values.ndim == 2 and values.shape[1] == count,
        f"the mean functions give values {values.shape} at {count} points: Fields give one row for each function",
    )
    return MeansAtData(means.gradient(points.gradient_points).astype(dtype), values.astype(dtype))


@program
def _sample_coefficients(
    posterior: TrigonometricPosterior, key: PRNGKeyArray, means: MeansAtData, scale: Float[Array, "*s"] | None
) -> Float[Array, "s a a a"]:
    draws = posterior.prior_draws(key, len(means.values))
    # Do not multiply by a scale of one, which would change how XLA rounds the neighbouring sums.
    if scale is not None:
        draws = jax.tree.map(lambda draw: draw * scale.reshape(-1, *(1,) * (draw.ndim - 1)), draws)
    return posterior.condition_draws(draws, means)
