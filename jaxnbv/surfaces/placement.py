"""Placements of known shapes in the scene, and sets of possible placements."""

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

# 1 / phi and 1 / psi of super-Fibonacci sampling (Alexa 2022): phi^2 = 2, and psi^4 = psi + 4.
_INVERSE_PHI, _INVERSE_PSI = 1.0 / math.sqrt(2.0), 1.0 / 1.533751168755204288118041


class Placement(eqx.Module):
    """The map u -> R (s u) + t from a shape's own frame to the scene. Leading axes make a batch.

    - `rotation`: R.
    - `shift`: t, in scene units.
    - `scale`: s > 0, one factor for each axis of the shape.
    """

    rotation: Float[Array, "*batch 3 3"]
    shift: Float[Array, "*batch 3"]
    scale: Float[Array, "*batch 3"]

    @property
    def factor(self) -> Float[Array, "*batch"]:
        """Factor on distances: the geometric mean of `scale`, which is exact if all scales are equal."""
        return jnp.exp(jnp.mean(jnp.log(self.scale), axis=-1))

    def to_shape(self, x: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """Map points of the scene to the shape's own frame."""
        offset = x - self.shift
        # R^T x is written as a sum, because XLA fuses a sum with the next operations, but not a matrix product.
        rotated = sum(offset[..., i, None] * self.rotation[i] for i in range(3))
        return rotated / self.scale

    def distance(self, solid: SignedDistance, x: Float[Array, "n 3"]) -> Float[Array, " n"]:
        """Return the signed distance of the placed solid at points of the scene."""
        return self.factor * solid(self.to_shape(x))

    def moved(self, step: Float[Array, "9"]) -> "Placement":
        """Return a copy that is rotated about the origin of the shape, shifted and scaled.

        - `step`: rotation vector (radians, scene axes), shift (scene units), and logarithms of factors on `scale`.
        """
        return Placement(
            jnp.matmul(rotation_from_vector(step[:3]), self.rotation, precision="highest"),
            self.shift + step[3:6],
            self.scale * jnp.exp(step[6:]),
        )


class ShapePoses(eqx.Module):
    """A set of possible placements of known shapes.

    - `scale`: smallest and largest scale factor, as multiples of the factor at which the shape fills the box around the
      object. Two equal numbers fix the scale.
    - `by_axis`: whether each axis of a shape is scaled separately.

    **Raises:** `ValueError` for scales that are not positive, or a smallest scale above the largest.
    """

    scale: tuple[float, float] = eqx.field(static=True, default=(0.8, 1.25), kw_only=True)
    by_axis: bool = eqx.field(static=True, default=False, kw_only=True)

    def __check_init__(self):
        check_fields(self)
        smallest, largest = self.scale
        require(0 < smallest <= largest, f"the scales are {self.scale}; give the smallest (above 0) and the largest")

    @abstractmethod
    def rotations(self, count: int) -> Float[AnyArray, "m 3 3"]:
        """Return at most `count` start rotations, spread evenly over the possible rotations."""

    @abstractmethod
    def rotation_axes(self) -> Float[np.ndarray, "3 k"]:
        """Return unit vectors, as columns, of the axes about which a placement can rotate."""

    @property
    def rigid_basis(self) -> Float[np.ndarray, "9 k"]:
        """Basis, as columns, of the steps of `Placement.moved` that do not change the scale."""
        return scipy.linalg.block_diag(self.rotation_axes(), np.eye(3), np.zeros((3, 0)))

    @property
    def step_basis(self) -> Float[np.ndarray, "9 k"]:
        """Basis, as columns, of the possible steps of `Placement.moved`."""
        smallest, largest = self.scale
        scales = np.zeros((3, 0)) if smallest == largest else np.eye(3) if self.by_axis else np.full((3, 1), 3**-0.5)
        return scipy.linalg.block_diag(self.rotation_axes(), np.eye(3), scales)

    def rotations_of(self, num_shapes: int, count: int) -> Float[AnyArray, "k m 3 3"]:
        """Return at most `count` start rotations for each of the first `num_shapes` shapes of a bank.

        The first axis has length one if all shapes share the rotations.
        """
        return self.rotations(count)[None]


class FreeRotation(ShapePoses):
    """Any rotation, for an object that may lie on any side."""

    def rotations(self, count: int) -> Float[np.ndarray, "m 3 3"]:
        """Return `count` rotations on a super-Fibonacci spiral of unit quaternions (Alexa 2022)."""
        index = np.arange(count) + 0.5
        inner, outer = np.sqrt(index / count), np.sqrt(1.0 - index / count)
        a, b = 2.0 * np.pi * index * _INVERSE_PHI, 2.0 * np.pi * index * _INVERSE_PSI
        x, y, z, w = inner * np.sin(a), inner * np.cos(a), outer * np.sin(b), outer * np.cos(b)
        return Rotation.from_quat(np.stack([x, y, z, w], axis=1)).as_matrix()

    def rotation_axes(self) -> Float[np.ndarray, "3 k"]:
        return np.eye(3)


class Upright(ShapePoses):
    """Any rotation about the vertical.

    - `axis`: the vertical direction, which is the same in the frames of the shapes and in the scene.
    - `within`: the search starts at angles between -`within` and `within`, in radians. Refined angles may lie outside.

    **Raises:** `ValueError` for a zero axis, an angle `within` outside (0, pi], and whenever `ShapePoses` raises it.
    """

    axis: tuple[float, float, float] = eqx.field(static=True, default=(0.0, 1.0, 0.0))
    within: float = eqx.field(static=True, default=math.pi)

    def __check_init__(self):
        check_fields(self)
        require(any(self.axis), "the vertical is zero; give a direction, such as (0, 1, 0)")
        require(0 < self.within <= math.pi, f"turns are searched within {self.within} rad; give an angle in (0, pi]")

    def rotations(self, count: int) -> Float[np.ndarray, "m 3 3"]:
        """Return at most `count` rotations, at evenly spaced angles that are at least two degrees apart."""
        count = max(1, min(count, round(self.within / math.radians(1.0))))
        angles = self.within * ((2.0 * np.arange(count) + 1.0) / count - 1.0)
        return Rotation.from_rotvec(angles[:, None] * self._unit).as_matrix()

    def rotation_axes(self) -> Float[np.ndarray, "3 k"]:
        return self._unit[:, None]

    @property
    def _unit(self) -> Float[np.ndarray, "3"]:
        return np.asarray(self.axis) / np.linalg.norm(self.axis)


class AsGiven(ShapePoses):
    """Placements that shift and scale shapes, but keep the orientation that shapes have in the bank."""

    def rotations(self, count: int) -> Float[np.ndarray, "m 3 3"]:
        return np.eye(3)[None]

    def rotation_axes(self) -> Float[np.ndarray, "3 k"]:
        return np.zeros((3, 0))
