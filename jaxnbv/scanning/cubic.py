"""The cubic polynomial of a cell's trilinear function along a ray, and the first root of this cubic.

A batch of n vectors is a list of three components (n,), in coordinates in which the cell is [0, 1]^3. A batch of n
cubics is a list of four coefficients (n,), constant first.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

CORNERS = tuple((i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1))

_ROOT_ITERATIONS = 8


def cubic(corners: list, a: list, b: list) -> list[Float[Array, " n"]]:
    """Return the coefficients of the cubic polynomials of trilinear functions along rays.

    On the ray a + s b the function is c_0 + c_1 s + c_2 s^2 + c_3 s^3. The corner values are interpolated linearly
    along z, y and x in turn, and each of these steps raises the degree by one.

    - `corners`: values of the functions at the corners of their cells, in the order of `CORNERS`.
    """
    polynomials = [[corner] for corner in corners]
    for x, dx in ((a[2], b[2]), (a[1], b[1]), (a[0], b[0])):
        merged = []
        for p, q in zip(polynomials[0::2], polynomials[1::2], strict=True):
            difference = [qi - pi for pi, qi in zip(p, q, strict=True)]
            constant = [pi + di * x for pi, di in zip(p, difference, strict=True)]
            linear = [di * dx for di in difference]
            merged.append([constant[0], *(c + d for c, d in zip(constant[1:], linear[:-1], strict=True)), linear[-1]])
        polynomials = merged
    return polynomials[0]


def first_bracket(c: list) -> tuple[Float[Array, " n"], Bool[Array, " n"]]:
    """Return an s for which [0, s] holds only the first root of each cubic, and whether [0, 1] has a root.

    If a cubic is positive at 0 but not at a local minimum in (0, 1), it has exactly one root up to this minimum, and s
    is the position of the minimum. Otherwise s is 1: a cubic that is positive at 0 then has one root in [0, 1] if it is
    not positive at 1, else none. A cubic that is not positive at 0 counts as having its first root there.
    """
    discriminant = c[2] * c[2] - 3.0 * c[3] * c[1]
    root = jnp.sqrt(jnp.maximum(discriminant, 0.0))
    # The minimum is a root of the derivative. There are two formulas for it, and each avoids cancellation for one sign
    # of c_2.
    numerator = jnp.where(c[2] > 0, -c[1], root - c[2])
    denominator = jnp.where(c[2] > 0, c[2] + root, 3.0 * c[3])
    minimum = numerator / jnp.where(denominator == 0, 1.0, denominator)
    exists = (discriminant > 0) & (denominator != 0) & (minimum > 0) & (minimum < 1)
    dips = exists & (_polynomial(c, minimum) <= 0)
    return jnp.where(dips, minimum, 1.0), dips | (c[0] <= 0) | (_polynomial(c, 1.0) <= 0)


def first_root(c: list) -> Float[Array, " n"]:
    """Return the first root in [0, 1] of each cubic. There must be one.

    The root is 0 for a cubic that is not positive at 0. Newton's method finds the root in the interval of
    `first_bracket`. A step that leaves the interval by more than the rounding error is replaced by bisection. Smaller
    excesses are allowed because compiled code may round the same value in two ways, and the interval may then end just
    beside the root.
    """
    high, _ = first_bracket(c)
    drop = c[0] - _polynomial(c, high)
    run = high / jnp.where(drop > 0, drop, 1.0)
    secant = jnp.clip(c[0] * run, 0.0, high)
    slack = 32.0 * jnp.finfo(high.dtype).eps * sum(map(jnp.abs, c)) * run

    def refine(_, state):
        low, high, s = state
        value = _polynomial(c, s)
        slope = c[1] + s * (2.0 * c[2] + s * 3.0 * c[3])
        low, high = jnp.where(value > 0, s, low), jnp.where(value > 0, high, s)
        newton = s - value / jnp.where(slope == 0, 1.0, slope)
        return low, high, jnp.where((newton >= low - slack) & (newton <= high + slack), newton, 0.5 * (low + high))

    _, _, s = jax.lax.fori_loop(0, _ROOT_ITERATIONS, refine, (jnp.zeros_like(high), high, secant))
    return jnp.where(c[0] <= 0, 0.0, jnp.clip(s, 0.0, 1.0))


def _polynomial(c: list, s) -> Float[Array, " n"]:
    return c[0] + s * (c[1] + s * (c[2] + s * c[3]))
