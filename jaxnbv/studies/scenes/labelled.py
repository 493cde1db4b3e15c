"""Functions that build solids with labelled surfaces from primitives.

An object is a list of primitives, which `assemble` joins into a `LabelledSolid`. A primitive is a rounded box, or the
solid that a rounded rectangle sweeps when it revolves about an axis: a ring, a wheel, a rod, a cone or a ball. All
solids with the same number of slots for primitives share one compiled program for scanning.
"""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxnbv.checks import require
from jaxnbv.scanning.sdf import UNUSED, LabelledSolid

# Number of slots for primitives in a solid. Larger solids have a multiple of this number.
CAPACITY = 24

_IDENTITY = np.eye(3)


@dataclasses.dataclass(frozen=True)
class Primitive:
    """One primitive, as NumPy arrays on the host. For the fields see `LabelledSolid`."""

    label: int
    centre: np.ndarray
    rotation: np.ndarray
    half_size: np.ndarray
    rounding: float
    radius: float = 0.0
    slant: float = 0.0
    revolved: bool = False

    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """Return the lowest and highest corner of the primitive's exact bounding box."""
        inner = self.half_size - self.rounding
        if not self.revolved:
            reach = np.abs(self.rotation) @ inner + self.rounding
            return self.centre + np.stack([-reach, reach])
        # Project both directions of each coordinate axis onto the plane of the swept rectangle, and apply the slant.
        up = np.stack([-self.rotation[:, 1], self.rotation[:, 1]])
        out = np.sqrt(np.maximum(1.0 - up**2, 0.0))
        up = up + self.slant * out
        reach = out * (self.radius + inner[0]) + np.abs(up) * inner[1] + self.rounding * np.hypot(out, up)
        return self.centre + np.array([[-1.0], [1.0]]) * reach


def box(label: int, centre, half_size, rounding: float = 0.02, axis_angle: tuple | None = None) -> Primitive:
    """Return a box with rounded edges.

    - `rounding`: radius of the edges, at most the smallest half size.
    - `axis_angle`: axis and angle (radians) of a right-handed rotation of the box about its centre.
    """
    half_size = np.asarray(half_size, dtype=float)
    rotation = np.eye(3) if axis_angle is None else rotation_about(*axis_angle)
    return Primitive(label, np.asarray(centre, dtype=float), rotation, half_size, min(rounding, half_size.min()))


def bar(label: int, start, end, half_width: float, half_depth: float, rounding: float = 0.02) -> Primitive:
    """Return a box with rounded edges that extends from `start` to `end`.

    - `half_width`: half the bar's size in the horizontal direction across it (z if the bar is upright).
    - `half_depth`: half the bar's size in the other direction across it.
    """
    start, end = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
    half_size = np.array([half_depth, 0.5 * np.linalg.norm(end - start), half_width])
    rotation = _upright(end - start)
    return Primitive(label, 0.5 * (start + end), rotation, half_size, min(rounding, half_size.min()))


def ring(
    label: int,
    centre,
    axis,
    radius: float,
    half_width: float,
    half_height: float,
    rounding: float = 0.02,
    slant: float = 0.0,
) -> Primitive:
    """Return the solid that a rounded rectangle sweeps when it revolves about `axis`.

    - `centre`: point of the axis at half the solid's height.
    - `radius`: distance of the rectangle's centre from the axis.
    - `half_width`, `half_height`: half sizes of the rectangle across and along the axis.
    - `slant`: growth of the distance from the axis per unit of height.
    """
    half_size = np.array([half_width, half_height, half_height])
    rounding = min(rounding, half_width, half_height)
    return Primitive(label, np.asarray(centre, dtype=float), _upright(axis), half_size, rounding, radius, slant, True)


def rod(label: int, start, end, radius: float, end_radius: float | None = None, rounding: float = 0.02) -> Primitive:
    """Return a rod with flat ends. If `end_radius` is given, the radius changes linearly to it."""
    start, end = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
    length = float(np.linalg.norm(end - start))
    end_radius = radius if end_radius is None else end_radius
    slant, mean = (end_radius - radius) / length, 0.5 * (radius + end_radius)
    return ring(label, 0.5 * (start + end), end - start, 0.0, mean, 0.5 * length, rounding, slant)


def path(label: int, points, radius: float) -> list[Primitive]:
    """Return rods with round ends that follow the polyline through the points."""
    points = np.asarray(points, dtype=float)
    rods = []
    for start, end in itertools.pairwise(points):
        extension = radius * (end - start) / np.linalg.norm(end - start)
        rods.append(rod(label, start - extension, end + extension, radius, rounding=radius))
    return rods


def ball(label: int, centre, radius: float) -> Primitive:
    """Return a ball."""
    return ring(label, centre, (0.0, 1.0, 0.0), 0.0, radius, radius, radius)


def shift(point, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Float[np.ndarray, "3"]:
    """Return a point moved by x, y and z along the coordinate axes."""
    return np.asarray(point, dtype=float) + np.array([x, y, z])


def rotation_about(axis, angle: float) -> Float[np.ndarray, "3 3"]:
    """Return the matrix of the right-handed rotation about an axis by an angle in radians."""
    return Rotation.from_rotvec(angle * np.asarray(axis, dtype=float) / np.linalg.norm(axis)).as_matrix()


def _upright(axis):
    """Return a rotation whose second column is the direction `axis` and whose third column is horizontal."""
    axis = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    level = np.cross(axis, [0.0, 1.0, 0.0])
    if np.linalg.norm(level) < 1e-6:
        level = np.array([0.0, 0.0, 1.0])
    level /= np.linalg.norm(level)
    return np.stack([np.cross(axis, level), axis, level], axis=1)


def assemble(primitives: list[Primitive], rotation_angle: float = 0.0, longest_side: float = 2.5) -> LabelledSolid:
    """Return the union of primitives, rotated about the y axis by an angle in radians, moved and scaled.

    The bounding box of the result is centred at the origin, and its longest side is `longest_side`.
    """
    rotation = rotation_about((0.0, 1.0, 0.0), rotation_angle)
    return union(fit([move(p, rotation=rotation) for p in primitives], longest_side))


def move(p: Primitive, scale: float = 1.0, rotation=_IDENTITY, offset=0.0) -> Primitive:
    """Return a primitive moved by x -> scale rotation x + offset."""
    return dataclasses.replace(
        p,
        centre=scale * rotation @ p.centre + offset,
        rotation=rotation @ p.rotation,
        half_size=scale * p.half_size,
        rounding=scale * p.rounding,
        radius=scale * p.radius,
    )


def bounds(primitives: list[Primitive]) -> Float[np.ndarray, "2 3"]:
    """Return the lowest and highest corner of the joint bounding box of primitives."""
    lows, highs = zip(*(p.bounds() for p in primitives), strict=True)
    return np.stack([np.min(lows, axis=0), np.max(highs, axis=0)])


def fit(primitives: list[Primitive], longest_side: float) -> list[Primitive]:
    """Move and scale primitives so that their joint bounding box is centred, with this longest side."""
    low, high = bounds(primitives)
    scale = longest_side / (high - low).max()
    return [move(p, scale, offset=-0.5 * scale * (low + high)) for p in primitives]


def union(primitives: list[Primitive], capacity: int = CAPACITY) -> LabelledSolid:
    """Return the union of primitives, with `capacity` slots for primitives.

    **Raises:** `ValueError` if there are no primitives, or more primitives than the capacity.
    """
    count = len(primitives)
    require(1 <= count <= capacity, f"the object has {count} primitives; a solid holds 1 to {capacity}")
    spare = Primitive(UNUSED, np.zeros(3), np.eye(3), np.zeros(3), rounding=0.0)
    slots = primitives + [spare] * (capacity - count)
    fields = {field.name: jnp.asarray([getattr(p, field.name) for p in slots]) for field in dataclasses.fields(spare)}
    return LabelledSolid(labels=fields.pop("label"), **fields)


def generator(key) -> np.random.Generator:
    """Return a NumPy generator seeded by a JAX key, for objects that are built on the host."""
    return np.random.default_rng(np.asarray(jax.random.key_data(key)))
