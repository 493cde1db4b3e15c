"""Base classes of distributions over implicit surfaces: the prior, the posterior and its samples."""

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
from jaxnbv.programs import program

HALF_WIDTH = 0.5 * math.pi
"""Half the side of the scene, which is the cube [-HALF_WIDTH, HALF_WIDTH]^3. Observed points must lie in it."""

_NUM_SAMPLES = 64


def _on_torus(has_shape: Callable[[Any], bool], description: str) -> Callable[..., Any]:
    """Make a decorator that checks that a method's arguments are arrays of coordinates in [-pi, pi].

    Sampled functions have the period 2 pi, so points outside [-pi, pi]^3 would only repeat points inside.

    - `has_shape`: function that says whether an array has the right shape.
    - `description`: the right shape in words, for the error message.
    """

    def decorate(method: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(method)
        def call(self: Any, *arrays: Any) -> Any:
            arrays = tuple(map(native, arrays))
            for array in arrays:
                coordinates = array if is_traced(array) else as_numbers(array, "the coordinates", None)
                require(has_shape(coordinates), f"the coordinates have shape {coordinates.shape}: give {description}")
                if is_traced(coordinates, self) or not coordinates.size:
                    continue
                largest = float(np.abs(coordinates).max())
                require(
                    largest <= 2.0 * HALF_WIDTH + 1e-6,
                    f"a point has a coordinate of {largest:.4g}, outside [-pi, pi]^3, where surfaces only repeat; the "
                    "scene is [-pi/2, pi/2]^3: bring the points there with Frame.to_scene",
                )
            with own_settings():
                return method(self, *arrays)

        return call

    return decorate


on_torus = _on_torus(lambda x: x.ndim == 2 and x.shape[1] == 3, "points (n, 3)")
on_grid_of_torus = _on_torus(lambda axis: axis.ndim == 1, "the nodes along one axis of a grid (g,)")


def sampling_method(method: Callable[..., Any]) -> Callable[..., Any]:
    """Decorator: check the random key and number of samples. **Raises:** `ValueError` if one is wrong."""

    @functools.wraps(method)
    def call(self: Any, key: PRNGKeyArray, num_samples: int) -> Any:
        check_key(key)
        check_type(num_samples, int, "the number of samples")
        require(num_samples >= 1, f"asked for {num_samples} samples; ask for at least one")
        with own_settings():
            return method(self, key, int(num_samples))

    return call


class Fields(eqx.Module):
    """Sampled implicit functions f_1, ..., f_S that can be evaluated anywhere in the scene."""

    @abstractmethod
    def __call__(self, x: Float[AnyArray, "n 3"]) -> Float[Array, "s n"]:
        """Return the values of all samples at the points x (scene coordinates)."""

    @on_torus
    def gradient(self, x: Float[AnyArray, "n 3"]) -> Float[Array, "s n 3"]:
        """Return the gradients of all samples at the points x (scene coordinates)."""
        x = jnp.asarray(x)

        def derivative(direction):
            # The value at a point depends on this point alone. So one `jvp` gives a derivative at all points.
            return jax.jvp(self, (x,), (jnp.broadcast_to(direction, x.shape),))[1]

        return jnp.moveaxis(jax.vmap(derivative)(jnp.eye(3, dtype=x.dtype)), 0, -1)

    @on_grid_of_torus
    def on_grid(self, axis: Float[AnyArray, " g"]) -> Float[Array, "s g g g"]:
        """Return the values of all samples on the tensor grid axis x axis x axis (scene coordinates)."""
        return on_tensor_grid(self, axis)


class SurfacePosterior(eqx.Module):
    """The posterior p(f | D). The surface is where f equals `level`, and f is greater outside.

    A subclass defines `level` and `sample`, and overrides `mean`, `variance` and `probability_inside` if it has closed
    forms. By default, these three are estimated from 64 samples, which are drawn with a fixed key.
    """

    level: eqx.AbstractVar[Float[Array, ""]]

    @abstractmethod
    def sample(self, key: PRNGKeyArray, num_samples: int) -> Fields:
        """Draw `num_samples` independent samples of the whole function f."""

    @property
    def has_closed_forms(self) -> bool:
        """Whether the class overrides `mean`, which is otherwise estimated from samples."""
        return type(self).mean is not SurfacePosterior.mean

    def kinds(self) -> dict[str, float]:
        """Return the probability of each kind of known shape, most likely first. By default there is none."""
        return {}

    def names_of_samples(self, key: PRNGKeyArray, num_samples: int) -> list[str]:
        """Return, for each sample that `sample` draws with this key, the name of its known shape, or ""."""
        return [""] * num_samples

    def mean(self, x: Float[AnyArray, "n 3"]) -> Float[Array, " n"]:
        """Return E f(x). The default is the mean of 64 samples, with standard error sqrt(Var f(x) / 64)."""
        return jnp.mean(self._draw_samples()(x), axis=0)

    def variance(self, x: Float[AnyArray, "n 3"]) -> Float[Array, " n"]:
        """Return Var f(x). The default is the variance of 64 samples, with denominator 63."""
        return jnp.var(self._draw_samples()(x), axis=0, ddof=1)

    def probability_inside(self, x: Float[AnyArray, "n 3"]) -> Float[Array, " n"]:
        """Return P(f(x) < level). The default is the fraction of 64 samples that are below the level at x."""
        return jnp.mean(self._draw_samples()(x) < self.level, axis=0)

    @on_grid_of_torus
    @program
    def mean_on_grid(self, axis: Float[AnyArray, " g"]) -> Float[Array, "g g g"]:
        """Return E f on the tensor grid axis x axis x axis (scene coordinates)."""
        if self.has_closed_forms:
            return on_tensor_grid(self.mean, axis)
        return jnp.mean(self._draw_samples().on_grid(axis), axis=0)

    def _draw_samples(self) -> Fields:
        return self.sample(jax.random.key(0), _NUM_SAMPLES)


class SurfaceModel(eqx.Module):
    """A prior p(f) over implicit surfaces that can be conditioned on observations."""

    @abstractmethod
    def condition(self, observations: Observations | PointCloud) -> SurfacePosterior:
        """Return the posterior p(f | observations).

        All models use the filled rows of the cloud. Some models also use the space that was seen to be empty.
        Implementations convert a `PointCloud` with `as_observations`.
        """

    def add_state(self, observations: Observations) -> Observations:
        """Return the observations, with the model's state for the next view added if it has any.

        The loop calls this method after each view. By default there is no state.
        """
        return observations

    def in_scene(self, frame: Frame) -> "SurfaceModel":
        """Return a copy in which sizes of known parts, if any, are converted from world to scene units."""
        return self

    @property
    def carries_hypotheses(self) -> bool:
        """Whether `add_state` adds `PartHypotheses` about which known part the object is."""
        return False

    def check(self, cloud: PointCloud) -> None:
        """Warn if a cloud does not suit the model. Do not call this under `jit`, because it reads values."""
        return
