"""Volumes that can hold the object, given as signed distances, and points on their boundaries."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxnbv.checks import AnyArray, InputError, require, short_text, takes_native
from jaxnbv.geometry.pose import fibonacci_sphere
from jaxnbv.programs import program

Volume = Callable[[Float[Array, "n 3"]], Float[Array, " n"]]
"""A volume, given as a function of points in scene coordinates, such as a `Box` or a solid of `jaxnbv.sdf`.

The function returns a signed distance: negative inside the volume, positive outside, and of a magnitude that is at most
the distance to the boundary.
"""

_BISECTIONS = 40
# All scenes lie within this distance of the origin, in scene units.
_OUTER_RADIUS = 3.0


def _corner(values) -> Float[np.ndarray, " 3"]:
    try:
        return np.array([float(value) for value in values])
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"a corner of a box is {short_text(values)}; give three numbers") from error


class Box(eqx.Module):
    """The box between two opposite corners. The default holds every object that `Frame.fit` scales.

    - `low`, `high`: the corners, three numbers each, in scene coordinates unless stated otherwise. The numbers become
      arrays (3,), so that a program compiled for one box runs for any box.

    **Raises:** `ValueError` if a side is not positive or a corner is not finite.
    """

    low: Any = eqx.field(converter=_corner, default=(-1.25, -1.25, -1.25))
    high: Any = eqx.field(converter=_corner, default=(1.25, 1.25, 1.25))

    def __check_init__(self):
        is_valid = self.low.shape == self.high.shape == (3,)
        require(
            is_valid and all(0 < side < math.inf for side in (self.high - self.low).tolist()),
            f"a box {self} has no inside: each of three sides must be positive and finite",
        )

    def __hash__(self) -> int:
        return hash((*self.low.tolist(), *self.high.tolist()))

    def __str__(self) -> str:
        low, high = (tuple(np.asarray(corner).tolist()) for corner in (self.low, self.high))
        return f"from {low} to {high}"

    def widened(self, margin: float) -> "Box":
        """Return the box with all faces but the lower one (y is up) moved outward by `margin`.

        The lower face stays, because the surface that the object stands on is below it.
        """
        return Box(self.low - np.array([margin, 0.0, margin]), self.high + margin)

    def shares_beyond(self, points: Float[np.ndarray, "n 3"], margin: float) -> dict[str, float]:
        """Return, keyed by face ("+x", ...), the fraction of points more than `margin` beyond the face."""
        if len(points) == 0:
            return {}
        is_beyond = {"-": points < self.low - margin, "+": points > self.high + margin}
        means = {sign: rows.mean(axis=0) for sign, rows in is_beyond.items()}
        return {f"{sign}{axis}": float(means[sign][index]) for index, axis in enumerate("xyz") for sign in means}

    @classmethod
    def cube(cls, side: float) -> "Box":
        """Return the cube that is centred at the origin and has sides of length `side`."""
        return cls((-0.5 * side,) * 3, (0.5 * side,) * 3)

    @takes_native
    @program
    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        """Return the exact signed distance from the points x to the faces of the box, negative inside."""
        x = jnp.asarray(x)
        low, high = jnp.asarray(self.low, x.dtype), jnp.asarray(self.high, x.dtype)
        center, half = 0.5 * (low + high), 0.5 * (high - low)
        excess = jnp.abs(x - center) - half
        outside = jnp.sqrt(jnp.sum(jnp.maximum(excess, 0.0) ** 2, axis=-1))
        return outside + jnp.minimum(jnp.max(excess, axis=-1), 0.0)


def ray_interval(
    origin: Sequence[Float[Array, "*#n"]],
    direction: Sequence[Float[Array, "*#n"]],
    low: Sequence[float] | Float[AnyArray, "3"],
    high: Sequence[float] | Float[AnyArray, "3"],
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Return the t at which rays origin + t direction enter and leave a box (Kay and Kajiya 1986).

    A ray misses the box if the t at which it enters is larger than the t at which it leaves.

    - `origin`, `direction`: x, y and z components of all rays, as three arrays each.
    """
    safe = [jnp.where(jnp.abs(d) < 1e-9, 1e-9, d) for d in direction]
    sides = [((a - x) / d, (b - x) / d) for x, d, a, b in zip(origin, safe, low, high, strict=True)]
    enter = functools.reduce(jnp.maximum, [jnp.minimum(p, q) for p, q in sides])
    leave = functools.reduce(jnp.minimum, [jnp.maximum(p, q) for p, q in sides])
    return enter, leave


@program
def boundary_points(volume: Volume, count: int, level: float = 0.0) -> Float[Array, "count 3"]:
    """Return points where `count` evenly spread rays from the origin cross the boundary of a volume.

    Bisection between the origin and a sphere beyond the scene finds one crossing per ray, even if there are more. The
    volume must enclose the origin, see `check_encloses_origin`.

    - `level`: value of the volume's function at the returned points, in scene units; positive for points outside.
    """
    directions = fibonacci_sphere(count)

    def halve(_, interval):
        near, far = interval
        middle = 0.5 * (near + far)
        is_inside = volume(middle[:, None] * directions) < level
        return jnp.where(is_inside, middle, near), jnp.where(is_inside, far, middle)

    ends = jnp.zeros(count, directions.dtype), jnp.full(count, _OUTER_RADIUS, directions.dtype)
    near, far = jax.lax.fori_loop(0, _BISECTIONS, halve, ends)
    return 0.5 * (near + far)[:, None] * directions


def check_encloses_origin(volume: Volume) -> None:
    """Raise `ValueError` if the origin is not inside the volume, as `boundary_points` needs it to be."""
    distance = float(volume(jnp.zeros((1, 3)))[0])
    require(
        distance < 0,
        f"the volume {volume} must enclose the origin, whose distance is {distance:.4g}: move the scene, so that the "
        "origin lies inside",
    )


def bounding_box(volume: Volume) -> Box:
    """Return the bounding box of a volume's boundary points along 1,000 rays, or a `Box` unchanged.

    **Raises:** `ValueError` if the volume is no `Box` and does not enclose the origin.
    """
    if isinstance(volume, Box):
        return volume
    check_encloses_origin(volume)
    points = np.asarray(boundary_points(volume, 1000), np.float64)
    return Box(np.min(points, axis=0), np.max(points, axis=0))
