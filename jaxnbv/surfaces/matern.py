"""The Matern spectrum on the circle of period 2 pi."""

import functools
import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Scalar = float | Float[Array, ""]


@functools.partial(jax.jit, static_argnames=("nu", "truncation"))
def circle_spectrum(nu: float, lengthscale: Scalar, variance: Scalar, truncation: int) -> Float[Array, "l_plus_1"]:
    """s1(0), ..., s1(L) with s1(n) = variance w(n) / sum_{m in Z} w(m), w(n) = (2 nu / ell^2 + 4 pi^2 n^2)^-(nu + 1/2).

    So sum_{n in Z} s1(n) cos(n t) is the Matern kernel on the circle, of value `variance` at t = 0 (Borovitskiy et al.
    2020). The sum over all integers is in closed form, so what the truncation leaves out is missing from the kernel
    and not spread over the frequencies that are kept.

    - `nu`: smoothness, one of 1/2, 3/2, 5/2.
    - `lengthscale`: ell, in units of the circumference.
    - `truncation`: L, the largest frequency.
    """
    a = math.sqrt(2.0 * nu) / jnp.asarray(lengthscale, dtype=jnp.result_type(float))
    frequency = jnp.arange(truncation + 1)
    weight = (1.0 + (2.0 * math.pi * frequency / a) ** 2) ** -(nu + 0.5)
    return variance * weight / _lattice_sum(nu, a)


def _lattice_sum(nu: float, a: Float[Array, ""]) -> Float[Array, ""]:
    """sum_{m in Z} (1 + (2 pi m / a)^2)^-p for p = nu + 1/2: a coth(a/2) / 2 for p = 1, then by derivatives in a."""
    decay = jnp.exp(-a)
    coth = (1.0 + decay) / (1.0 - decay)
    csch2 = 4.0 * decay / (1.0 - decay) ** 2
    if nu == 0.5:
        return a * coth / 2
    if nu == 1.5:
        return a * coth / 4 + a**2 * csch2 / 8
    return 3 * a * coth / 16 + 3 * a**2 * csch2 / 32 + a**3 * csch2 * coth / 32
