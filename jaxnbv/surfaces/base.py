"""What the rest of the library asks of a distribution over implicit surfaces: condition it, and sample."""

import functools
import math
from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxnbv.checks import AnyArray, as_numbers, check_key, check_type, is_traced, require
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.tensor_grid import on_tensor_grid
from jaxnbv.scanning.evidence import Evidence

HALF_WIDTH = 0.5 * math.pi
"""Scattered points must lie in [-HALF_WIDTH, HALF_WIDTH]^3, the cube that the paper scales a scene into."""


def on_torus(method: Callable[..., Any]) -> Callable[..., Any]:
    """A method of points (n, 3), which must lie on the torus, [-pi, pi]^3: beyond it functions only repeat. Its eighth
    in the middle is the scene; outside that nothing is known but that the surface does not lie there."""

    @functools.wraps(method)
    def call(self: Any, *points: Any) -> Any:
        for x in points:
            found = x if is_traced(x) else as_numbers(x, "the points", None)
            shaped = found.ndim == 2 and found.shape[1] == 3
            require(shaped, f"the points have shape {found.shape}: give an array (n, 3)")
            _check_on_torus(found, self)
        return method(self, *points)

    return call


def sampler(method: Callable[..., Any]) -> Callable[..., Any]:
    """A method of a key and a number of samples, at least one."""

    @functools.wraps(method)
    def call(self: Any, key: PRNGKeyArray, num_samples: int) -> Any:
        check_key(key)
        check_type(num_samples, int, "the number of samples")
        require(num_samples >= 1, f"asked for {num_samples} samples; ask for at least one")
        return method(self, key, int(num_samples))

    return call


def on_grid_of_torus(method: Callable[..., Any]) -> Callable[..., Any]:
    """A method of the nodes along one axis (g,) of a grid, which must lie on the torus as points of `on_torus` do."""

    @functools.wraps(method)
    def call(self: Any, axis: Any) -> Any:
        found = axis if is_traced(axis) else as_numbers(axis, "the nodes along an axis", None)
        require(found.ndim == 1, f"the nodes along an axis have shape {found.shape}: give an array (g,)")
        _check_on_torus(found, self)
        return method(self, axis)

    return call


def _check_on_torus(coordinates: Any, owner: Any) -> None:
    if is_traced(coordinates, owner) or not coordinates.size:
        return
    furthest = float(np.abs(coordinates).max())
    require(
        furthest <= 2.0 * HALF_WIDTH + 1e-6,
        f"a point has a coordinate of {furthest:.4g}, outside [-pi, pi]^3, where surfaces only repeat; the scene is "
        "[-pi/2, pi/2]^3: bring the points there with Frame.to_scene",
    )


class Fields(eqx.Module):
    """Sampled implicit functions f_1, ..., f_S, each to be evaluated anywhere in the scene."""

    @abstractmethod
    def __call__(self, x: Float[AnyArray, "n 3"]) -> Float[Array, "s n"]:
        """All samples at the points x (scene coordinates)."""

    @on_grid_of_torus
    def on_grid(self, axis: Float[AnyArray, " g"]) -> Float[Array, "s g g g"]:
        """All samples on the tensor grid axis x axis x axis (scene coordinates)."""
        return on_tensor_grid(self, axis)


class SurfacePosterior(eqx.Module):
    """p(f | D): the surface is where f equals `level`, and f is greater outside.

    An implementation gives `level` and `sample`. One that has closed forms also overrides `mean` and `variance`, which
    are Monte Carlo estimates here.
    """

    level: eqx.AbstractVar[Float[Array, ""]]

    @abstractmethod
    def sample(self, key: PRNGKeyArray, num_samples: int) -> Fields:
        """`num_samples` independent samples of the whole function f."""

    def mean(self, x: Float[AnyArray, "n 3"]) -> Float[Array, " n"]:
        """E f(x), here from 64 samples under a fixed key."""
        return jnp.mean(self.sample(jax.random.key(0), 64)(x), axis=0)

    @on_grid_of_torus
    @eqx.filter_jit
    def mean_on_grid(self, axis: Float[AnyArray, " g"]) -> Float[Array, "g g g"]:
        """E f on the tensor grid axis x axis x axis (scene coordinates)."""
        return on_tensor_grid(self.mean, axis)

    def variance(self, x: Float[AnyArray, "n 3"]) -> Float[Array, " n"]:
        """Var f(x), here from 64 samples under a fixed key."""
        return jnp.var(self.sample(jax.random.key(0), 64)(x), axis=0, ddof=1)


class SurfaceModel(eqx.Module):
    """p(f): a prior over implicit surfaces that can be conditioned on what was seen."""

    @abstractmethod
    def condition(self, evidence: Evidence | PointCloud) -> SurfacePosterior:
        """p(f | evidence): the filled rows of its cloud and, where the model can make use of it, the space that was
        seen empty. A cloud alone is evidence too; `Evidence.of` makes it so."""

    def check(self, cloud: PointCloud) -> None:
        """Warn where a cloud, whose values are known, is not one that the model makes much of."""
        return
