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

from jaxnbv.checks import AnyArray, as_numbers, check_key, check_type, is_traced, native, own_settings, require
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.tensor_grid import on_tensor_grid
from jaxnbv.observations import Observations

HALF_WIDTH = 0.5 * math.pi
"""Scattered points must lie in [-HALF_WIDTH, HALF_WIDTH]^3, the cube that the paper scales a scene into."""

_ESTIMATED_BY = 64


def _on_torus(is_given: Callable[[Any], bool], wanted: str) -> Callable[..., Any]:
    """Of a method, that its arguments are arrays of a shape, on the torus, [-pi, pi]^3: beyond it functions only
    repeat. Its eighth in the middle is the scene; outside that nothing is known but that the surface is not there."""

    def checking(method: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(method)
        def call(self: Any, *arrays: Any) -> Any:
            arrays = tuple(map(native, arrays))
            for array in arrays:
                found = array if is_traced(array) else as_numbers(array, "the coordinates", None)
                require(is_given(found), f"the coordinates have shape {found.shape}: give {wanted}")
                if is_traced(found, self) or not found.size:
                    continue
                furthest = float(np.abs(found).max())
                require(
                    furthest <= 2.0 * HALF_WIDTH + 1e-6,
                    f"a point has a coordinate of {furthest:.4g}, outside [-pi, pi]^3, where surfaces only repeat; the "
                    "scene is [-pi/2, pi/2]^3: bring the points there with Frame.to_scene",
                )
            with own_settings():
                return method(self, *arrays)

        return call

    return checking


on_torus = _on_torus(lambda x: x.ndim == 2 and x.shape[1] == 3, "points (n, 3)")
on_grid_of_torus = _on_torus(lambda axis: axis.ndim == 1, "the nodes along one axis of a grid (g,)")


def sampling_method(method: Callable[..., Any]) -> Callable[..., Any]:
    """A method of a key and a number of samples, at least one."""

    @functools.wraps(method)
    def call(self: Any, key: PRNGKeyArray, num_samples: int) -> Any:
        check_key(key)
        check_type(num_samples, int, "the number of samples")
        require(num_samples >= 1, f"asked for {num_samples} samples; ask for at least one")
        with own_settings():
            return method(self, key, int(num_samples))

    return call


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
    `probability_inside` by them; those that it leaves are estimated from S = 64 samples drawn under a fixed key,
    the same functions for all points.
    """

    level: eqx.AbstractVar[Float[Array, ""]]

    @abstractmethod
    def sample(self, key: PRNGKeyArray, num_samples: int) -> Fields:
        """`num_samples` independent samples of the whole function f."""

    @property
    def has_closed_forms(self) -> bool:
        """Whether it has its own `mean`; else moments are estimated from samples."""
        return type(self).mean is not SurfacePosterior.mean

    def kinds(self) -> dict[str, float]:
        """How likely the object is of each kind of known shape, most likely first; empty where no shapes are known."""
        return {}

    def names_of_samples(self, key: PRNGKeyArray, num_samples: int) -> list[str]:
        """The known shape that each of the samples of `sample` is about; empty names where no shapes are known."""
        return [""] * num_samples

    def mean(self, x: Float[AnyArray, "n 3"]) -> Float[Array, " n"]:
        """E f(x), here the mean of samples, of standard error sqrt(Var f / S)."""
        return jnp.mean(self._kept()(x), axis=0)

    def variance(self, x: Float[AnyArray, "n 3"]) -> Float[Array, " n"]:
        """Var f(x), here that of samples, S - 1 in its denominator."""
        return jnp.var(self._kept()(x), axis=0, ddof=1)

    def probability_inside(self, x: Float[AnyArray, "n 3"]) -> Float[Array, " n"]:
        """P(f(x) < level), here the share of samples."""
        return jnp.mean(self._kept()(x) < self.level, axis=0)

    @on_grid_of_torus
    @eqx.filter_jit
    def mean_on_grid(self, axis: Float[AnyArray, " g"]) -> Float[Array, "g g g"]:
        """E f on the tensor grid axis x axis x axis (scene coordinates)."""
        if self.has_closed_forms:
            return on_tensor_grid(self.mean, axis)
        return jnp.mean(self._kept().on_grid(axis), axis=0)

    def _kept(self) -> Fields:
        return self.sample(jax.random.key(0), _ESTIMATED_BY)


class SurfaceModel(eqx.Module):
    """p(f): a prior over implicit surfaces that can be conditioned on what was seen."""

    @abstractmethod
    def condition(self, observations: Observations | PointCloud) -> SurfacePosterior:
        """p(f | observations): the filled rows of its cloud and, where the model can make use of it, the space that was
        seen empty. A cloud alone is observations too; `as_observations` makes it so."""

    def observed(self, observations: Observations) -> Observations:
        """The observations with what the model carries from view to view; asked after each view."""
        return observations

    def in_scene(self, frame: Frame) -> "SurfaceModel":
        """The model, given in the world of a frame as far as it knows true sizes, in the scene."""
        return self

    @property
    def carries_hypotheses(self) -> bool:
        """Whether `observed` keeps hypotheses about which known part the object is, see `PartHypotheses`."""
        return False

    def check(self, cloud: PointCloud) -> None:
        """Warn where a cloud, whose values are known, is not one that the model makes much of."""
        return
