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

    @on_torus
    def gradient(self, x: Float[AnyArray, "n 3"]) -> Float[Array, "s n 3"]:
        """The gradients of all samples at the points x, here by forward differentiation of their values."""
        x = jnp.asarray(x)

        def along(direction):
            # A value depends on its own point alone, so that all points can be moved at once.
            return jax.jvp(self, (x,), (jnp.broadcast_to(direction, x.shape),))[1]

        return jnp.moveaxis(jax.vmap(along)(jnp.eye(3, dtype=x.dtype)), 0, -1)

    @on_grid_of_torus
    def on_grid(self, axis: Float[AnyArray, " g"]) -> Float[Array, "s g g g"]:
        """All samples on the tensor grid axis x axis x axis (scene coordinates)."""
        return on_tensor_grid(self, axis)


class SurfacePosterior(eqx.Module):
    """p(f | D): the surface is where f equals `level`, and f is greater outside.

    An implementation gives `level` and `sample`. One that has closed forms overrides `mean`, `variance` and
    `probability_inside` by them; those that it leaves are estimated from samples drawn under a fixed key.
    """

    level: eqx.AbstractVar[Float[Array, ""]]

    @abstractmethod
    def sample(self, key: PRNGKeyArray, num_samples: int) -> Fields:
        """`num_samples` independent samples of the whole function f."""

    @property
    def has_closed_forms(self) -> bool:
        """Whether it has its own `mean`; else moments are estimated from samples."""
        return type(self).mean is not SurfacePosterior.mean

    def drawn(self, num_samples: int = 64) -> "SurfacePosterior":
        """The posterior itself where it has closed forms; else with samples drawn once, under a fixed key, by which
        its moments are estimated. Ask it for more than one moment: the samples are then drawn once.

        **Raises:** `ValueError` if `num_samples` < 2.
        """
        check_type(num_samples, int, "the number of samples")
        require(num_samples >= 2, f"a variance of {num_samples} samples was asked for; ask for at least two")
        return self if self.has_closed_forms else self._estimated(num_samples)

    def mean(self, x: Float[AnyArray, "n 3"]) -> Float[Array, " n"]:
        """E f(x), here as samples estimate it."""
        return self._estimated().mean(x)

    def variance(self, x: Float[AnyArray, "n 3"]) -> Float[Array, " n"]:
        """Var f(x), here as samples estimate it."""
        return self._estimated().variance(x)

    def probability_inside(self, x: Float[AnyArray, "n 3"]) -> Float[Array, " n"]:
        """P(f(x) < level), here as samples estimate it."""
        return self._estimated().probability_inside(x)

    def _estimated(self, num_samples: int = 64) -> "SampledPosterior":
        return SampledPosterior(self.level, self, self.sample(jax.random.key(0), num_samples))

    @on_grid_of_torus
    @eqx.filter_jit
    def mean_on_grid(self, axis: Float[AnyArray, " g"]) -> Float[Array, "g g g"]:
        """E f on the tensor grid axis x axis x axis (scene coordinates)."""
        drawn = self.drawn()
        return on_tensor_grid(self.mean, axis) if drawn is self else drawn.mean_on_grid(axis)


class SampledPosterior(SurfacePosterior):
    """A posterior whose moments are estimated from samples drawn once: the same functions for all points, so that the
    mean is smooth, and variances and probabilities belong to it.

    - `level`: that of the posterior.
    - `posterior`: what was sampled. `sample` draws from it anew: its samples are not among those that are kept.
    - `fields`: the samples that are kept, at least two.

    With S samples the standard error of the mean is its standard deviation / sqrt(S), that of a probability p is
    sqrt(p (1 - p) / S), and that of a Gaussian variance is sqrt(2 / (S - 1)) of it.
    """

    level: Float[Array, ""]
    posterior: SurfacePosterior
    fields: Fields

    def sample(self, key: PRNGKeyArray, num_samples: int) -> Fields:
        """`num_samples` independent samples of the posterior, as its own `sample` draws them."""
        return self.posterior.sample(key, num_samples)

    def mean(self, x: Float[AnyArray, "n 3"]) -> Float[Array, " n"]:
        """Mean of the samples at the points x (scene coordinates)."""
        return jnp.mean(self.fields(x), axis=0)

    def variance(self, x: Float[AnyArray, "n 3"]) -> Float[Array, " n"]:
        """Variance of the samples at the points x, with S - 1 in its denominator."""
        return jnp.var(self.fields(x), axis=0, ddof=1)

    def probability_inside(self, x: Float[AnyArray, "n 3"]) -> Float[Array, " n"]:
        """Share of the samples that are below the level at the points x."""
        return jnp.mean(self.fields(x) < self.level, axis=0)

    @on_grid_of_torus
    @eqx.filter_jit
    def mean_on_grid(self, axis: Float[AnyArray, " g"]) -> Float[Array, "g g g"]:
        """Mean of the samples on the tensor grid axis x axis x axis, for which all of them are held there at once."""
        return jnp.mean(self.fields.on_grid(axis), axis=0)


class SurfaceModel(eqx.Module):
    """p(f): a prior over implicit surfaces that can be conditioned on what was seen."""

    @abstractmethod
    def condition(self, evidence: Evidence | PointCloud) -> SurfacePosterior:
        """p(f | evidence): the filled rows of its cloud and, where the model can make use of it, the space that was
        seen empty. A cloud alone is evidence too; `Evidence.of` makes it so."""

    def check(self, cloud: PointCloud) -> None:
        """Warn where a cloud, whose values are known, is not one that the model makes much of."""
        return
