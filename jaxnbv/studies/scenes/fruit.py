"""Stand-ins for the fruits of OmniObject3D, which are told apart by what is small: stem, calyx, pores, tips, gills."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from jaxnbv.checks import AnyArray, require
from jaxnbv.scanning.sdf import Matrix, Scalar, Vector, nonnegative, norm, parameter
from jaxnbv.studies.scenes.class_object import ClassObject
from jaxnbv.studies.scenes.framing import Framing
from jaxnbv.studies.scenes.splits import Split, scene_key

FRUITS = ("apple", "lemon", "mango", "mushroom", "orange")
# What a fruit has not: nothing is divided by zero, and what has no cut is cut far below.
_ZERO, _ONE, _UNCUT = (0.0, 0.0), (1.0, 1.0), (-4.0, -4.0)
# The range of each of a fruit's numbers, in units of its half height, for each of `FRUITS`.
_RANGES = {
    "width": ((1.02, 1.15), (0.68, 0.82), (0.6, 0.72), (1.0, 1.25), (1.0, 1.1)),
    "depth": ((1.02, 1.15), (0.68, 0.82), (0.48, 0.58), (1.0, 1.25), (1.0, 1.1)),
    "top": ((-0.42, -0.28), (0.14, 0.26), (-0.06, -0.02), _ZERO, (0.04, 0.08)),
    "top_spread": ((0.3, 0.42), (0.18, 0.28), (0.12, 0.2), _ONE, (0.08, 0.12)),
    "bottom": ((-0.24, -0.12), (0.04, 0.14), (0.0, 0.08), _ZERO, (-0.1, -0.03)),
    "bottom_spread": ((0.26, 0.36), (0.2, 0.3), (0.25, 0.35), _ONE, (0.12, 0.2)),
    "lobes": ((0.05, 0.09), _ZERO, _ZERO, _ZERO, _ZERO),
    "stalk_low": ((0.45, 0.5), _ZERO, _ZERO, (-1.0, -0.6), _ZERO),
    "stalk_high": ((0.95, 1.2), _ZERO, _ZERO, (0.2, 0.3), _ZERO),
    "stalk_lean": ((-0.2, 0.2), _ZERO, _ZERO, (-0.12, 0.12), _ZERO),
    "stalk_radius": ((0.055, 0.075), _ZERO, _ZERO, (0.26, 0.4), _ZERO),
    "pores": (_ZERO, (0.008, 0.018), _ZERO, _ZERO, (0.015, 0.028)),
    "pore_number": (_ZERO, (11.0, 14.0), _ZERO, _ZERO, (12.0, 16.0)),
    "bend": (_ZERO, _ZERO, (0.1, 0.24), _ZERO, _ZERO),
    "cut": (_UNCUT, _UNCUT, _UNCUT, (0.02, 0.2), _UNCUT),
    "gills": (_ZERO, _ZERO, _ZERO, (0.03, 0.06), _ZERO),
}
_NUM_GILLS = 16
# Deeper inside than this nothing is met, and directions from the middle are not defined.
_DEEPEST = 0.2


class Fruit(ClassObject):
    """A body of revolution with tips or dimples, lobes, pores and a stalk, or cut below for a cap with gills; a bound.

    In its own frame the body's axis is y and its half height about 1. A point u of it has the direction
    d = q / |q|, q = ((u_x - bend (1 - u_y^2)) / width, u_y, u_z / depth), and lies on the body where |q| is

        1 + top exp(-(1 - d_y) / top_spread^2) + (bottom + lobes c_5) exp(-(1 + d_y) / bottom_spread^2)
          + pores sin(k d_x) sin(k d_y) sin(k d_z),

    c_5 the cosine of five times the angle about the axis and k the `pore_number`. A `cut` takes away what is lower,
    a surface with gills. The stalk is a round rod from `stalk_low` to `stalk_high`. It lies at
    `scale * rotation @ u + offset` in the scene; `steepness` is the greatest slope of these formulas.

    - `label`: the class, an index of `FRUITS`.
    """

    label: Int[Array, ""]
    numbers: dict[str, Float[Array, ""]]
    steepness: Scalar = nonnegative()
    rotation: Matrix = parameter()
    scale: Scalar = nonnegative()
    offset: Vector = parameter()

    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        a, b, c = (x[..., i, None] - self.offset[i] for i in range(3))
        rotation = self.rotation / self.scale
        own = a * rotation[0] + b * rotation[1] + c * rotation[2]
        return (self.scale / self.steepness) * _level(self.numbers, own[..., 0], own[..., 1], own[..., 2])


def fruit_scene(split: Split, index: int, framing: Framing = Framing.CLOSE_UP, turned: bool = True) -> Fruit:
    """Scene number `index` of a split; the classes take turns. See `sample_fruit`.

    **Raises:** `ValueError` if the index is negative.
    """
    return sample_fruit(scene_key(7, split, index), index % len(FRUITS), framing.longest_side, turned)


def sample_fruit(
    key: PRNGKeyArray, label: int | Int[AnyArray, ""], longest_side: float = 2.5, turned: bool = True
) -> Fruit:
    """A random fruit of a class, turned at random or, not `turned`, upright along y; its bounding box is centred and
    has the given longest side.

    Runs under `jit` and `vmap`.

    **Raises:** `ValueError` if `longest_side` is not positive.
    """
    require(longest_side > 0, f"the longest side is {longest_side}; it must be positive")
    return _sample(key, jnp.asarray(label), longest_side, turned)


@functools.partial(jax.jit, static_argnames="turned")
def _sample(key: PRNGKeyArray, label: Int[Array, ""], longest_side: Float[Array, ""] | float, turned: bool) -> Fruit:
    number_key, rotation_key, place_key = jax.random.split(key, 3)
    low, high = jnp.array(list(_RANGES.values())).T
    drawn = jax.random.uniform(number_key, (len(_RANGES),), minval=low[label], maxval=high[label])
    numbers = dict(zip(_RANGES, drawn, strict=True))
    rotation = jax.random.orthogonal(rotation_key, 3)
    rotation = rotation * jnp.linalg.det(rotation) if turned else jnp.eye(3)

    surface = _surface_points(numbers)
    corners = jnp.matmul(surface, rotation.T, precision="highest")
    least_corner, greatest_corner = jnp.min(corners, axis=0), jnp.max(corners, axis=0)
    scale = longest_side / jnp.max(greatest_corner - least_corner)
    anywhere = jax.random.uniform(place_key, (4096, 3), minval=-1.6, maxval=1.6)
    near = [factor * surface for factor in (0.8, 0.86, 0.92, 0.96, 1.0, 1.05)]
    steepest = 1.1 * jnp.max(_slopes(numbers, jnp.concatenate([*near, anywhere])))
    offset = -0.5 * scale * (least_corner + greatest_corner)
    return Fruit(label, numbers, jnp.maximum(steepest, 1.0), rotation, scale, offset)


def _level(n: dict[str, Array], x: Array, y: Array, z: Array) -> Array:
    """Zero on the surface, before it is divided by its steepness."""
    q = (x - n["bend"] * (1.0 - y**2)) / n["width"], y, z / n["depth"]
    length = norm(*q)
    direction = tuple(c / jnp.maximum(length, _DEEPEST) for c in q)
    narrowest = jnp.minimum(jnp.minimum(n["width"], n["depth"]), 1.0)
    body = narrowest * jnp.maximum(length - _radius(n, *direction), -_DEEPEST)
    cap = jnp.maximum(body, _lowest(n, x, z) - y)
    low, high, radius = n["stalk_low"], n["stalk_high"], n["stalk_radius"]
    tall = jnp.maximum(high - low, 1e-3)
    along = jnp.clip((y - low) / tall, 0.0, 1.0)
    lean = n["stalk_lean"] * along
    # Without a stalk it is a point inside the body.
    stalk = norm(x - lean, y - low - tall * along, z) - radius
    return jnp.minimum(cap, stalk)


def _lowest(n: dict[str, Array], x: Array, z: Array) -> Array:
    """The height below which the body is cut away."""
    return n["cut"] + n["gills"] * _turns(x, z, _NUM_GILLS) / (x**2 + z**2 + 0.02) ** (0.5 * _NUM_GILLS)


def _radius(n: dict[str, Array], x: Array, y: Array, z: Array) -> Array:
    """How far the body reaches in a direction, in units of its axes."""
    lobes = n["lobes"] * _turns(x, z, 5) / (x**2 + z**2 + 0.01) ** 2.5
    top = n["top"] * jnp.exp(-(1.0 - y) / n["top_spread"] ** 2)
    bottom = (n["bottom"] + lobes) * jnp.exp(-(1.0 + y) / n["bottom_spread"] ** 2)
    k = n["pore_number"]
    return 1.0 + top + bottom + n["pores"] * jnp.sin(k * x) * jnp.sin(k * y) * jnp.sin(k * z)


def _turns(x: Array, z: Array, count: int) -> Array:
    """r^count cos(count phi) in polar coordinates (r, phi), a polynomial."""
    real, imaginary = x, z
    for _ in range(count - 1):
        real, imaginary = real * x - imaginary * z, real * z + imaginary * x
    return real


def _surface_points(n: dict[str, Array]) -> Float[Array, "points 3"]:
    """Points of the body, or where it is cut of the cut, and of the stalk."""
    index = jnp.arange(8000) + 0.5
    y = 1.0 - index / 4000
    turn, flat = jnp.pi * (3.0 - jnp.sqrt(5.0)) * index, jnp.sqrt(1.0 - y**2)
    x, z = flat * jnp.cos(turn), flat * jnp.sin(turn)
    radius = _radius(n, x, y, z)
    tall = radius * y
    u = jnp.stack([n["width"] * radius * x + n["bend"] * (1.0 - tall**2), tall, n["depth"] * radius * z], axis=-1)
    # What was cut away moves to the middle of the cut, which is inside the box.
    u = jnp.where((tall < _lowest(n, u[:, 0], u[:, 2]))[:, None], jnp.stack([0.0, n["cut"], 0.0]), u)
    ends = jnp.stack([jnp.stack([0.0, n["stalk_low"], 0.0]), jnp.stack([n["stalk_lean"], n["stalk_high"], 0.0])])
    directions = jnp.stack([x, y, z], axis=-1)[::6]
    rods = ends[:, None] + n["stalk_radius"] * directions
    return jnp.concatenate([u, rods.reshape(-1, 3)])


def _slopes(n: dict[str, Array], x: Float[Array, "points 3"]) -> Float[Array, " points"]:
    gradient = jax.vmap(jax.grad(lambda u: _level(n, u[0], u[1], u[2])))(x)
    return jnp.linalg.norm(gradient, axis=-1)
