"""The Matern spectrum on the circle, and prior covariances of the function f and the normal field v.

    cov(v_d(x), v_d(y)) = sum_n s(n) cos(n.(x - y))
    cov(f(x), v_d(y))   = sum_n s(n) n_d / |n|^2 sin(n.(x - y))
    cov(f(x), f(y))     = sum_n s(n) / |n|^2 cos(n.(x - y)),   n != 0

The sums are over integer frequency vectors n with components from -L to L, and v_d is component d of v. The spectrum
s(n) is a product over the axes, s1(n_1) s1(n_2) s1(n_3). A prior with several lengthscales has one spectrum for each,
and its covariances are sums over the spectra.

For one spectrum, the first covariance is a product over the axes. The other two are computed as short sums of such
products, because 1 / r = int exp(-r e^u) e^u du, with r = |n|^2, is close to a short sum of exponentials of r (Beylkin
and Monzon 2010). So no array over the (2 L + 1)^3 frequencies is needed.
"""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxnbv.surfaces.trigonometric import basis_variance, circle_basis

Scalar = float | Float[Array, ""]
Spectrum = Float[Array, "l_plus_1"]
Spectra = Float[Array, "*scales l_plus_1"]


@functools.partial(jax.jit, static_argnames=("nu", "truncation"))
def circle_spectrum(nu: float, lengthscale: Scalar, variance: Scalar, truncation: int) -> Float[Array, "l_plus_1"]:
    """Compute the Matern spectrum s1(0), ..., s1(L) on the circle.

    s1(n) = variance w(n) / sum_{m in Z} w(m),   w(n) = (2 nu / ell^2 + 4 pi^2 n^2)^-(nu + 1/2)

    The function sum_{n in Z} s1(n) cos(n t) is the Matern kernel on the circle, with value `variance` at t = 0
    (Borovitskiy et al. 2020). The sum over m includes all integers, and has a closed form. So truncation removes the
    variance of frequencies above L from the kernel, and does not move it to lower frequencies.

    - `nu`: smoothness, one of 1/2, 3/2, 5/2.
    - `lengthscale`: ell, in units of the circumference.
    - `truncation`: L, the largest frequency.
    """
    a = math.sqrt(2.0 * nu) / jnp.asarray(lengthscale, dtype=jnp.result_type(float))
    frequency = jnp.arange(truncation + 1)
    weight = (1.0 + (2.0 * math.pi * frequency / a) ** 2) ** -(nu + 0.5)
    return variance * weight / _lattice_sum(nu, a)


def _lattice_sum(nu: float, a: Float[Array, ""]) -> Float[Array, ""]:
    """Return the sum over all integers m of (1 + (2 pi m / a)^2)^-p, where p = nu + 1/2.

    For p = 1 the sum is a coth(a/2) / 2. The sums for larger p follow by differentiation with respect to a.
    """
    decay = jnp.exp(-a)
    coth = (1.0 + decay) / (1.0 - decay)
    csch2 = 4.0 * decay / (1.0 - decay) ** 2
    if nu == 0.5:
        return a * coth / 2
    if nu == 1.5:
        return a * coth / 4 + a**2 * csch2 / 8
    return 3 * a * coth / 16 + 3 * a**2 * csch2 / 32 + a**3 * csch2 * coth / 32


def normal_covariance(x: Float[Array, "n 3"], y: Float[Array, "m 3"], spectrum: Spectra) -> Float[Array, "n m"]:
    """Return the prior cov(v_d(x), v_d(y)), the same for each of the independent components d of v."""
    return _sum_scales(lambda single: _normal_covariance(x, y, single), spectrum)


def _sum_scales(covariance, spectra: Spectra):
    return functools.reduce(jnp.add, [covariance(single) for single in jnp.atleast_2d(spectra)])


def _normal_covariance(x, y, spectrum: Spectrum):
    even = [_cosine_sum(x[:, axis], y[:, axis], spectrum) for axis in range(3)]
    return even[0] * even[1] * even[2]


def function_normal_covariance(
    x: Float[Array, "n 3"], y: Float[Array, "m 3"], spectrum: Spectra
) -> Float[Array, "3 n m"]:
    """Return the prior cov(f(x), v_d(y)) for each component d = 1, 2, 3 of the normal field v."""

    def products(damped):
        odd_spectrum = damped * jnp.arange(damped.size, dtype=damped.dtype)
        even = [_cosine_sum(x[:, axis], y[:, axis], damped) for axis in range(3)]
        odd = [_sine_sum(x[:, axis], y[:, axis], odd_spectrum) for axis in range(3)]
        return jnp.stack([odd[0] * even[1] * even[2], even[0] * odd[1] * even[2], even[0] * even[1] * odd[2]])

    return _sum_scales(lambda single: _inverse_square_sum(products, single), spectrum)


def function_covariance(x: Float[Array, "n 3"], y: Float[Array, "m 3"], spectrum: Spectra) -> Float[Array, "n m"]:
    """Return the prior cov(f(x), f(y)) of the implicit function f."""

    def covariance(spectrum):
        return _inverse_square_sum(lambda damped: _normal_covariance(x, y, damped) - spectrum[0] ** 3, spectrum)

    return _sum_scales(covariance, spectrum)


def function_variance(spectrum: Spectra) -> Float[Array, ""]:
    """Return the prior variance of f, which is the same at all points: sum_n s(n) / |n|^2 for n != 0."""
    origin = jnp.zeros((1, 3), dtype=spectrum.dtype)
    return function_covariance(origin, origin, spectrum)[0, 0]


def mode_variance(spectrum: Spectra) -> Float[Array, "a a a"]:
    """Return the prior variance of each trigonometric coefficient of a component of the normal field."""

    def of_one(spectrum):
        variance = basis_variance(spectrum)
        return variance[:, None, None] * variance[:, None] * variance

    return jnp.sum(jax.vmap(of_one)(jnp.atleast_2d(spectrum)), axis=0)


def _cosine_sum(x: Float[Array, " n"], y: Float[Array, " m"], spectrum: Spectrum) -> Float[Array, "n m"]:
    """Return the sum over n = -L, ..., L of s1(|n|) cos(n (x - y)), where `spectrum` is s1(0), ..., s1(L)."""
    truncation = spectrum.shape[0] - 1
    weighted = circle_basis(x, truncation) * basis_variance(spectrum)
    return jnp.matmul(weighted, circle_basis(y, truncation).T, precision="highest")


def _sine_sum(x: Float[Array, " n"], y: Float[Array, " m"], spectrum: Spectrum) -> Float[Array, "n m"]:
    """Return the sum over n = -L, ..., L of s1(|n|) sign(n) sin(n (x - y)).

    Here `spectrum` is s1(0), ..., s1(L). The sum uses sin(n (x - y)) = sin(n x) cos(n y) - cos(n x) sin(n y).
    """
    truncation = spectrum.shape[0] - 1
    sign = jnp.sign(jnp.arange(-truncation, truncation + 1))
    # Reversing the basis swaps the sine and the cosine of each frequency.
    swapped = sign * circle_basis(x, truncation)[:, ::-1]
    return jnp.matmul(swapped * basis_variance(spectrum), circle_basis(y, truncation).T, precision="highest")


def _inverse_square_sum(products, spectrum: Spectrum):
    """Return the sum over frequency vectors n that `products` computes, with each term divided by |n|^2.

    - `products`: returns the sum without the division, given s1(0), ..., s1(L). Its term for n must be proportional to
      s1(n_1) s1(n_2) s1(n_3), and zero for n = 0.
    """
    frequency = jnp.arange(spectrum.shape[0], dtype=spectrum.dtype)

    def add(total, node):
        rate, weight = node
        return total + weight * products(spectrum * jnp.exp(-rate * frequency**2)), None

    # Use a loop, because XLA would hold all unrolled terms in memory at once.
    nodes = tuple(jnp.asarray(a, dtype=spectrum.dtype) for a in _inverse_quadrature(spectrum))
    shape = jax.eval_shape(products, spectrum)
    return jax.lax.scan(add, jnp.zeros(shape.shape, shape.dtype), nodes)[0]


def _inverse_quadrature(spectrum: Spectrum) -> tuple[np.ndarray, np.ndarray]:
    """Return rates t_q and weights w_q with sum_q w_q exp(-t_q r) close to 1 / r for 1 <= r <= 3 L^2.

    Here L is the largest frequency of the spectrum. The logarithms of the rates are evenly spaced, as in the
    trapezoidal rule. The weights are fitted by least squares, because the weights of the trapezoidal rule would need
    more rates at both ends. The relative error is at most 100 times the precision of the spectrum's dtype.
    """
    tolerance = 10 * float(jnp.finfo(spectrum.dtype).eps)
    largest = 3.0 * (spectrum.shape[0] - 1) ** 2
    low, high = -0.75 - math.log(largest), math.log(math.log(1.0 / tolerance)) - 0.5
    count = math.ceil((high - low) * math.log(10.0 / tolerance) / math.pi**2) + 1
    rate = np.exp(np.linspace(low, high, count))
    r = largest ** (0.5 + 0.5 * np.cos(np.linspace(0.0, math.pi, 8 * count)))
    # `np.linalg.lstsq` would drop small singular values, and so lose half of the digits of float64.
    q, upper = np.linalg.qr(r[:, None] * np.exp(-np.outer(r, rate)))
    return rate, np.linalg.solve(upper, q.sum(axis=0))
