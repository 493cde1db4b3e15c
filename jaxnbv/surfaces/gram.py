"""A = k(X, X) + noise^2 I, the covariance of the observed normals: its Cholesky factor, for clouds partly filled."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.surfaces.covariance import Spectra, normal_covariance
from jaxnbv.surfaces.matern import Scalar

_ALWAYS_WHOLE = 2048


def factorise(cloud: PointCloud, spectrum: Spectra, noise: Scalar) -> Float[Array, "n n"]:
    """Lower Cholesky factor of A, where a row that is not filled is a row of the identity.

    Such a row changes neither the solves nor the determinant.
    """
    capacity = cloud.capacity

    def leading(size: int):
        points, mask = cloud.points[:size], cloud.mask[:size]
        kernel = jnp.where(mask[:, None] & mask, normal_covariance(points, points, spectrum), 0.0)
        block = kernel + jnp.diag(jnp.where(mask, noise**2, 1.0))
        factor = jnp.linalg.cholesky(block, symmetrize_input=False)
        return jnp.eye(capacity, dtype=factor.dtype).at[:size, :size].set(factor)

    return on_filled_rows(cloud, leading)


def on_filled_rows(cloud: PointCloud, leading: Callable[[int], Float[Array, "*of"]]) -> Float[Array, "*of"]:
    """`leading(size)` for a share of the rows, the leading ones, that holds all that are filled: so the time follows
    them while the shapes stay fixed. Each share is compiled, which few rows are not worth."""
    capacity = cloud.capacity
    if capacity <= _ALWAYS_WHOLE:
        return leading(capacity)
    sizes = [-(-capacity * eighths // 8) for eighths in (2, 3, 4, 5, 6, 8)]
    filled = jnp.max(jnp.where(cloud.mask, jnp.arange(capacity) + 1, 0))
    return jax.lax.switch(
        jnp.searchsorted(jnp.asarray(sizes), filled), [functools.partial(leading, size) for size in sizes]
    )
