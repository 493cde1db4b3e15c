"""Band-limited functions on the torus of period 2 pi, in a real tensor basis.

The basis on the circle is phi_a(x) = cos(a x) for a = 0, ..., L and phi_a(x) = sin(-a x) for a = -L, ..., -1, where L
is the truncation, the largest frequency. The products phi_a(x1) phi_b(x2) phi_c(x3) span the same space as the paper's
exponentials, with the same number of real coefficients. In this basis, evaluation is a chain of real matrix products,
and differentiation along an axis maps the coefficients C_a, with index a on that axis, to a * C_{-a}.

All products request full float32 precision, because some GPUs use a lower precision by default.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.special import i0

from jaxnbv.checks import AnyArray
from jaxnbv.sharding import on_cpu, shared_map
from jaxnbv.surfaces.base import HALF_WIDTH, Fields, on_grid_of_torus, on_torus

_CHUNK_VALUES = 2**24


def circle_basis(x: Float[Array, "*n"], truncation: int) -> Float[Array, "*n a"]:
    """Return sin(L x), ..., sin(x), 1, cos(x), ..., cos(L x) along a new last axis; L is `truncation`."""
    angle = x[..., None] * jnp.arange(1, truncation + 1)
    return jnp.concatenate([jnp.sin(angle)[..., ::-1], jnp.ones_like(x)[..., None], jnp.cos(angle)], axis=-1)


def basis_variance(spectrum: Float[Array, "l_plus_1"]) -> Float[Array, " a"]:
    """Return the prior variances of the coefficients of `circle_basis` for a kernel on the circle.

    The kernel is the sum over n = -L, ..., L of s1(|n|) cos(n t), and `spectrum` is s1(0), ..., s1(L).
    """
    positive = 2.0 * spectrum[1:]
    return jnp.concatenate([positive[::-1], spectrum[:1], positive])


def differentiate(coefficients: Float[Array, "*s a a a"], axis: int) -> Float[Array, "*s a a a"]:
    """Return the coefficients of the partial derivative along an axis (0, 1 or 2)."""
    return _frequency(coefficients, axis) * jnp.flip(coefficients, axis - 3)


def solve_poisson(vector_field: Float[Array, "*s 3 a a a"]) -> Float[Array, "*s a a a"]:
    """Return the coefficients of the zero-mean f whose Laplacian is the divergence of a vector field v.

    The Fourier coefficients are f_hat(n) = -i n . v_hat(n) / |n|^2.
    """
    x, y, z = (differentiate(vector_field[..., axis, :, :, :], axis) for axis in range(3))
    return inverse_laplacian(x + y + z)


def inverse_laplacian(function: Float[Array, "*s a a a"]) -> Float[Array, "*s a a a"]:
    """Return the coefficients of the zero-mean f whose Laplacian is a function g minus the mean of g.

    The Fourier coefficients are f_hat(n) = -g_hat(n) / |n|^2.
    """
    a, b, c = (_frequency(function, axis) for axis in range(3))
    squared = a**2 + b**2 + c**2
    return -function / jnp.where(squared == 0, jnp.inf, squared)


def _frequency(coefficients: Float[Array, "*s a a a"], axis: int) -> Float[Array, "_ _ _"]:
    truncation = coefficients.shape[-1] // 2
    shape = [1, 1, 1]
    shape[axis] = -1
    return jnp.arange(-truncation, truncation + 1, dtype=coefficients.dtype).reshape(shape)


def evaluate_on_grid(
    coefficients: Float[Array, "*s a a a"], basis: Float[Array, "g a"] | Float[np.ndarray, "g a"]
) -> Float[Array, "*s g g g"]:
    """Return the values on a tensor grid, given the basis at the nodes along one axis of the grid."""
    values = jnp.einsum("...abc,kc->...abk", coefficients, basis, precision="highest")
    values = jnp.einsum("...abk,jb->...ajk", values, basis, precision="highest")
    return jnp.einsum("...ajk,ia->...ijk", values, basis, precision="highest")


class TrigonometricFields(Fields):
    """Band-limited functions, which are evaluated exactly anywhere on the torus.

    - `coefficients`: coefficients of phi_a(x1) phi_b(x2) phi_c(x3), with a leading axis of functions.
    """

    coefficients: Float[Array, "s a a a"]

    @on_torus
    def __call__(self, x: Float[AnyArray, "n 3"]) -> Float[Array, "s n"]:
        x = jnp.asarray(x, dtype=self.coefficients.dtype)
        samples, modes = self.coefficients.shape[0], self.coefficients.shape[-1]

        def evaluate(point):
            first, second, third = circle_basis(point, modes // 2)
            values = jnp.einsum("sabc,a->sbc", self.coefficients, first, precision="highest")
            return jnp.einsum("sbc,b,c->s", values, second, third, precision="highest")

        chunk = max(1, min(x.shape[0], _CHUNK_VALUES // (samples * modes**2)))
        return jax.lax.map(evaluate, x, batch_size=chunk).T

    @on_torus
    def gradient(self, x: Float[AnyArray, "n 3"]) -> Float[Array, "s n 3"]:
        derivatives = jnp.concatenate([differentiate(self.coefficients, axis) for axis in range(3)])
        return jnp.stack(jnp.split(TrigonometricFields(derivatives)(x), 3), axis=-1)

    @on_grid_of_torus
    def on_grid(self, axis: Float[AnyArray, " g"]) -> Float[Array, "s g g g"]:
        basis = circle_basis(jnp.asarray(axis, dtype=self.coefficients.dtype), self.coefficients.shape[-1] // 2)
        return shared_map(evaluate_on_grid, self.coefficients, basis)


class NonuniformTransform(eqx.Module):
    """Fast transforms between coefficients up to frequency L and values at given points of the scene.

    `evaluate` computes values on a tensor grid that covers the scene, twice as fine as frequency L needs, and
    interpolates them with a Kaiser-Bessel window. Beforehand it divides the coefficients by the window's Fourier
    transform (Dutt and Rokhlin 1993; Barnett, Magland and af Klinteberg 2019 on windows). The error is close to
    rounding error, about 1e-6 in float32 and 1e-12 in float64. `adjoint` is the transpose of `evaluate`.

    - `start`: first node of each point's window, per axis.
    - `weights`: the window's values at its nodes, per axis.
    """

    start: Int[Array, "n 3"]
    weights: Float[Array, "n 3 w"]
    truncation: int = eqx.field(static=True)

    def __init__(self, points: Float[Array, "n 3"], truncation: int):
        window, beta, step = _window(truncation, points.dtype)
        # XLA may compute `first` once for `start` and again for `weights`, and may round a multiplication followed by a
        # subtraction differently each time. The two results would then be a node apart. So only ceil directly follows
        # the multiplication.
        position = (points + HALF_WIDTH) * (1.0 / step)
        first = jnp.ceil(position) - window // 2
        offset = position[..., None] - first[..., None] - jnp.arange(window)
        radicand = jnp.maximum(1.0 - (2.0 * offset / window) ** 2, jnp.finfo(points.dtype).eps ** 2)
        self.start = (first + window // 2).astype(jnp.int32)
        weights = jnp.i0(beta * jnp.sqrt(radicand)) / float(i0(beta))
        # JAX clamps a slice that starts outside its array. That would use the wrong nodes, so these points give NaN.
        is_in_grid = (self.start >= 0) & (self.start <= 2 * truncation + 1)
        self.weights = jnp.where(is_in_grid[..., None], weights, jnp.nan)
        self.truncation = truncation

    def evaluate(self, coefficients: Float[Array, "k a a a"]) -> Float[Array, "n k"]:
        """Evaluate k functions, given by their coefficients, at the n points of the transform."""
        values = evaluate_on_grid(coefficients, self._node_basis(coefficients.dtype))
        return self._interpolate(jnp.moveaxis(values, 0, -1))

    def adjoint(self, values: Float[Array, "n k"]) -> Float[Array, "k a a a"]:
        """Apply the transpose of `evaluate`: sum_j values_j phi_a(x_j1) phi_b(x_j2) phi_c(x_j3)."""
        basis = self._node_basis(values.dtype)
        node_values = self._spread(values, basis.shape[0])
        return evaluate_on_grid(jnp.moveaxis(node_values, -1, 0), basis.T)

    def _interpolate(self, grid: Float[Array, "g g g k"]) -> Float[Array, "n k"]:
        def at_point(start, weights):
            return jnp.einsum("uvwk,u,v,w->k", self._window_of(grid, start), *weights, precision="highest")

        if not on_cpu():
            return jax.vmap(at_point)(self.start, self.weights)
        # The windows of this many points fit in the processor's cache.
        return jax.lax.map(lambda point: at_point(*point), (self.start, self.weights), batch_size=128)

    def _spread(self, values: Float[Array, "n k"], nodes: int) -> Float[Array, "nodes nodes nodes k"]:
        """Spread values at the points to the nodes of the grid: apply the transpose of `_interpolate`."""
        grid = jnp.zeros((nodes, nodes, nodes, values.shape[1]), values.dtype)
        if not on_cpu():
            return jax.linear_transpose(self._interpolate, grid)(values)[0]

        def add(row, grid):
            start, (x, y, z) = self.start[row], self.weights[row]
            block = x[:, None, None, None] * y[:, None, None] * z[:, None] * values[row]
            return jax.lax.dynamic_update_slice(grid, self._window_of(grid, start) + block, (*start, jnp.int32(0)))

        # On a CPU a loop over points is six times as fast as XLA's scatter.
        return jax.lax.fori_loop(0, len(values), add, grid)

    def _window_of(self, grid: Float[Array, "g g g k"], start: Int[Array, "3"]) -> Float[Array, "w w w k"]:
        window = self.weights.shape[-1]
        return jax.lax.dynamic_slice(grid, (*start, jnp.int32(0)), (window, window, window, grid.shape[-1]))

    def _node_basis(self, dtype) -> Float[Array, "g a"]:
        """Return the basis at the grid's nodes, divided by the window's Fourier transform at each frequency."""
        window, beta, step = _window(self.truncation, dtype)
        nodes = -HALF_WIDTH + step * (np.arange(2 * self.truncation + window + 1) - window // 2)
        frequency = np.abs(np.arange(-self.truncation, self.truncation + 1))
        root = np.sqrt(beta**2 - (0.5 * window * step * frequency) ** 2)
        transform = window * np.sinh(root) / (root * i0(beta))
        return circle_basis(jnp.asarray(nodes, dtype=dtype), self.truncation) / jnp.asarray(transform, dtype=dtype)


def _window(truncation: int, dtype) -> tuple[int, float, float]:
    """Return the number of nodes under the window, its shape parameter, and the spacing of the grid."""
    nodes = 8 if dtype == jnp.float32 else 14
    return nodes, 0.75 * math.pi * nodes, HALF_WIDTH / truncation
