"""How a known shape can stand in the scene: a placement, and which placements are possible."""

import math
from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from jaxnbv.checks import AnyArray, check_fields, require
from jaxnbv.geometry.rotations import rotation_from_vector
from jaxnbv.scanning.sdf import SignedDistance

_GOLDEN = 1.0 / 1.533751168755204288118041
_SILVER = 1.0 / math.sqrt(2.0)


class Placement(eqx.Module):
    """Points u of a shape's own frame stand at R (s u) + t in the scene, s along each axis of the shape.

    Leading axes make a batch.

    - `rotation`: R. `shift`: t, in scene units. `scale`: s > 0.
    """

    rotation: Float[Array, "*batch 3 3"]
    shift: Float[Array, "*batch 3"]
    scale: Float[Array, "*batch 3"]

    @property
    def factor(self) -> Float[Array, "*batch"]:
        """Scene units per unit of the shape's signed distance: the geometric mean of s, exact where all are equal."""
        return jnp.exp(jnp.mean(jnp.log(self.scale), axis=-1))

    def to_shape(self, x: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """Points of the scene in the shape's own frame."""
        away = x - self.shift
        # R^T x as a sum, which XLA fuses with what follows where it would not a matrix product.
        turned = sum(away[..., i, None] * self.rotation[i] for i in range(3))
        return turned / self.scale

    def distance(self, solid: SignedDistance, x: Float[Array, "n 3"]) -> Float[Array, " n"]:
        """The signed distance of the placed solid at points of the scene."""
        return self.factor * solid(self.to_shape(x))

    def moved(self, step: Float[Array, "9"]) -> "Placement":
        """Turned by the rotation vector of the first three numbers about t, shifted by the next three, and scaled by
        the exponentials of the last."""
        return Placement(
            jnp.matmul(rotation_from_vector(step[:3]), self.rotation, precision="highest"),
            self.shift + step[3:6],
            self.scale * jnp.exp(step[6:]),
        )


class ShapePoses(eqx.Module):
    """Which placements of known shapes are possible.

    - `scale`: the least and the greatest s, as shares of the scale at which the shape fills the box that holds the
      object; the same twice fixes it.
    - `by_axis`: whether the axes of a shape are scaled each on its own.

    **Raises:** `ValueError` for scales that are not positive, or the least above the greatest.
    """

    scale: tuple[float, float] = eqx.field(static=True, default=(0.8, 1.25), kw_only=True)
    by_axis: bool = eqx.field(static=True, default=False, kw_only=True)

    def __check_init__(self):
        check_fields(self)
        least, most = self.scale
        require(0 < least <= most, f"the scales are {self.scale}; give the least, positive, and the greatest")

    @abstractmethod
    def rotations(self, count: int) -> Float[AnyArray, "m 3 3"]:
        """At most `count` rotations, spread evenly over those that are possible: where a search starts."""

    @abstractmethod
    def turns(self) -> Float[np.ndarray, "3 k"]:
        """The axes about which a placement can be turned, one a column."""

    @property
    def moves(self) -> Float[np.ndarray, "9 k"]:
        """The independent steps of `Placement.moved` without a change of scale, one a column."""
        return scipy.linalg.block_diag(self.turns(), np.eye(3), np.zeros((3, 0)))

    @property
    def steps(self) -> Float[np.ndarray, "9 k"]:
        """The independent steps of `Placement.moved`, one a column."""
        least, most = self.scale
        scales = np.zeros((3, 0)) if least == most else np.eye(3) if self.by_axis else np.full((3, 1), 3**-0.5)
        return scipy.linalg.block_diag(self.turns(), np.eye(3), scales)

    def rotations_of(self, num_shapes: int, count: int) -> Float[AnyArray, "k m 3 3"]:
        """At most `count` rotations of each of some shapes; a first axis of one where they are those of all."""
        return self.rotations(count)[None]


class FreeRotation(ShapePoses):
    """Any rotation: an object that may lie on any side."""

    def rotations(self, count: int) -> Float[np.ndarray, "m 3 3"]:
        """A super-Fibonacci spiral of unit quaternions (Alexa 2022)."""
        index = np.arange(count) + 0.5
        inner, outer = np.sqrt(index / count), np.sqrt(1.0 - index / count)
        a, b = 2.0 * np.pi * index * _SILVER, 2.0 * np.pi * index * _GOLDEN
        x, y, z, w = inner * np.sin(a), inner * np.cos(a), outer * np.sin(b), outer * np.cos(b)
        return Rotation.from_quat(np.stack([x, y, z, w], axis=1)).as_matrix()

    def turns(self) -> Float[np.ndarray, "3 k"]:
        return np.eye(3)


class Upright(ShapePoses):
    """Any turn about the vertical.

    - `axis`: the vertical, of shapes and scene alike.
    - `within`: radians to either side to which a turn is searched; refined ones may exceed them.

    **Raises:** `ValueError` also for an axis of zero, or an angle that is not in (0, pi].
    """

    axis: tuple[float, float, float] = eqx.field(static=True, default=(0.0, 1.0, 0.0))
    within: float = eqx.field(static=True, default=math.pi)

    def __check_init__(self):
        check_fields(self)
        require(any(self.axis), "the vertical is zero; give a direction, such as (0, 1, 0)")
        require(0 < self.within <= math.pi, f"turns are searched within {self.within} rad; give an angle in (0, pi]")

    def rotations(self, count: int) -> Float[np.ndarray, "m 3 3"]:
        """Evenly spaced turns, no closer than two degrees."""
        count = max(1, min(count, round(self.within / math.radians(1.0))))
        angles = self.within * ((2.0 * np.arange(count) + 1.0) / count - 1.0)
        return Rotation.from_rotvec(angles[:, None] * self._unit).as_matrix()

    def turns(self) -> Float[np.ndarray, "3 k"]:
        return self._unit[:, None]

    @property
    def _unit(self) -> Float[np.ndarray, "3"]:
        return np.asarray(self.axis) / np.linalg.norm(self.axis)


class AsGiven(ShapePoses):
    """Not turned: as the bank holds it, but for shift and scale."""

    def rotations(self, count: int) -> Float[np.ndarray, "m 3 3"]:
        return np.eye(3)[None]

    def turns(self) -> Float[np.ndarray, "3 k"]:
        return np.zeros((3, 0))
