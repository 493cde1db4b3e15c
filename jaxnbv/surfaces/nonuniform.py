"""Fast transforms between coefficients and scattered points: a non-uniform Fourier transform on part of the torus.

A band-limited function is evaluated on a tensor grid that covers the scene, twice as fine as its highest frequency
asks for, and interpolated from there with a Kaiser-Bessel window whose effect on each frequency is divided out first.
The error is of the order of the rounding (some 1e-6 in float32, 1e-12 in float64). The adjoint is the transpose.
(Dutt and Rokhlin 1993; Barnett, Magland and af Klinteberg 2019 on windows.)
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.special import i0

from jaxnbv.surfaces.base import HALF_WIDTH
from jaxnbv.surfaces.trigonometric import circle_basis, evaluate_on_grid


class NonuniformTransform(eqx.Module):
    """Transforms between coefficients up to frequency L and values at given points.

    - `start`: first node of each point's window, per axis.
    - `weights`: the window's values at its nodes, per axis.
    """

    start: Int[Array, "n 3"]
    weights: Float[Array, "n 3 w"]
    truncation: int = eqx.field(static=True)

    def __init__(self, points: Float[Array, "n 3"], truncation: int):
        window, beta, step = _window(truncation, points.dtype)
        # XLA may compute `first` once for `start` and again for `weights`. A multiplication followed by a subtraction
        # may be rounded differently there, and the two would be a node apart: only ceil follows the multiplication.
        position = (points + HALF_WIDTH) * (1.0 / step)
        first = jnp.ceil(position) - window // 2
        offset = position[..., None] - first[..., None] - jnp.arange(window)
        radicand = jnp.maximum(1.0 - (2.0 * offset / window) ** 2, jnp.finfo(points.dtype).eps ** 2)
        self.start = (first + window // 2).astype(jnp.int32)
        self.weights = jnp.i0(beta * jnp.sqrt(radicand)) / float(i0(beta))
        self.truncation = truncation

    def evaluate(self, coefficients: Float[Array, "k a a a"]) -> Float[Array, "n k"]:
        """Values of k functions at the points."""
        values = evaluate_on_grid(coefficients, self._node_basis(coefficients.dtype))
        return self._interpolate(jnp.moveaxis(values, 0, -1))

    def adjoint(self, values: Float[Array, "n k"]) -> Float[Array, "k a a a"]:
        """sum_j values_j phi_a(x_j1) phi_b(x_j2) phi_c(x_j3): the transpose of `evaluate`."""
        basis = self._node_basis(values.dtype)
        nodes = basis.shape[0]
        grid = jax.ShapeDtypeStruct((nodes, nodes, nodes, values.shape[1]), values.dtype)
        (spread,) = jax.linear_transpose(self._interpolate, grid)(values)
        return evaluate_on_grid(jnp.moveaxis(spread, -1, 0), basis.T)

    def _interpolate(self, grid: Float[Array, "g g g k"]) -> Float[Array, "n k"]:
        window, k = self.weights.shape[-1], grid.shape[-1]

        def at_point(start, weights):
            block = jax.lax.dynamic_slice(grid, (*start, jnp.int32(0)), (window, window, window, k))
            return jnp.einsum("uvwk,u,v,w->k", block, *weights, precision="highest")

        return jax.vmap(at_point)(self.start, self.weights)

    def _node_basis(self, dtype) -> Float[Array, "g a"]:
        """The basis at the grid's nodes, each frequency divided by the window's Fourier transform there."""
        window, beta, step = _window(self.truncation, dtype)
        nodes = -HALF_WIDTH + step * (np.arange(2 * self.truncation + window + 1) - window // 2)
        frequency = np.abs(np.arange(-self.truncation, self.truncation + 1))
        root = np.sqrt(beta**2 - (0.5 * window * step * frequency) ** 2)
        transform = window * np.sinh(root) / (root * i0(beta))
        return circle_basis(jnp.asarray(nodes, dtype=dtype), self.truncation) / jnp.asarray(transform, dtype=dtype)


def _window(truncation: int, dtype) -> tuple[int, float, float]:
    """Nodes under the window, its shape parameter, and the grid's spacing: two nodes for each that L asks for."""
    nodes = 8 if dtype == jnp.float32 else 14
    return nodes, 0.75 * math.pi * nodes, HALF_WIDTH / truncation
