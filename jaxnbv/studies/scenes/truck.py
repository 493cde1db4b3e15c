"""A truck with an open bed that carries an object of one of ten classes: only the cargo tells the class."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from jaxnbv.checks import AnyArray, require
from jaxnbv.studies.scenes.class_object import ClassObject
from jaxnbv.studies.scenes.framing import Framing
from jaxnbv.studies.scenes.household import HOUSEHOLD, household_primitives
from jaxnbv.studies.scenes.labelled import (
    LabelledSolid,
    Primitive,
    bounds,
    box,
    fitted,
    generator,
    moved,
    rod,
    rotation_about,
    united,
)
from jaxnbv.studies.scenes.splits import Split, scene_key

_TRUCK, _CARGO = 0, 1


class LoadedTruck(ClassObject):
    """A truck and its cargo; a bound.

    - `truck`, `cargo`: where they stand in the scene.
    - `label`: the cargo's class, an index of `HOUSEHOLD`.
    """

    truck: LabelledSolid
    cargo: LabelledSolid
    label: Int[Array, ""]

    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        # One union of all primitives is half the program that a union of two would be.
        return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), self.truck, self.cargo)(x)

    def on_cue(self, x: Float[AnyArray, "*n 3"], tolerance: float = 2e-3) -> Bool[Array, "*n"]:
        """Those of the cargo."""
        return self.cargo(x) <= tolerance


def truck_scene(split: Split, index: int, framing: Framing = Framing.CLOSE_UP, turned: bool = True) -> LoadedTruck:
    """Scene number `index` of a split; the classes of the cargo take turns.

    The cargo is turned at random about the vertical, as large as the bed has room for, and the loaded truck in any
    direction, or, not `turned`, upright along y and along x; its bounding box is centred in the scene. Built on the
    host: it does not run under `jit`.

    **Raises:** `ValueError` if the index is negative.
    """
    return sample_truck(scene_key(5, split, index), index % len(HOUSEHOLD), framing.longest_side, turned)


def sample_truck(key: PRNGKeyArray, label: int, longest_side: float = 2.5, turned: bool = True) -> LoadedTruck:
    """A random truck with a random object of a class on its bed, as `truck_scene` places them.

    **Raises:** `ValueError` if there is no such class, or `longest_side` is not positive.
    """
    require(0 <= label < len(HOUSEHOLD), f"there is no class {label}: give 0 to {len(HOUSEHOLD) - 1}")
    require(longest_side > 0, f"the longest side is {longest_side}; it must be positive")
    rng = generator(key)
    truck, low, high = _truck(rng)
    turn = rotation_about((0.0, 1.0, 0.0), rng.uniform(-np.pi, np.pi))
    cargo = [moved(p, rotation=turn) for p in household_primitives(HOUSEHOLD[label], rng)]
    scale, offset = stowed(np.stack([low, high]), bounds(cargo), rng)
    cargo = [moved(p, scale, offset=offset) for p in cargo]
    rotation = random_rotation(rng) if turned else np.eye(3)
    both = fitted([moved(p, rotation=rotation) for p in truck + cargo], longest_side)
    solids = {"truck": united(both[: len(truck)]), "cargo": united(both[len(truck) :])}
    return LoadedTruck(**solids, label=jnp.asarray(label))


def stowed(
    room: Float[np.ndarray, "2 3"], cargo: Float[np.ndarray, "2 3"], rng: np.random.Generator
) -> tuple[float, Float[np.ndarray, "3"]]:
    """By what a cargo is scaled, and then moved, to stand on the floor of a bed, anywhere that it has room, as large
    as it can be or a little less. Both boxes are given by their lowest and highest corners."""
    side, size = np.diff(room, axis=0)[0], np.diff(cargo, axis=0)[0]
    scale = float((rng.uniform(0.85, 0.95) * side / size).min())
    corner = room[0] + (side - scale * size) * np.array([rng.random(), 0.0, rng.random()])
    return scale, corner - scale * cargo[0]


def random_rotation(rng: np.random.Generator) -> Float[np.ndarray, "3 3"]:
    """A uniform one, from the QR decomposition of a normal matrix."""
    rotation, triangle = np.linalg.qr(rng.normal(size=(3, 3)))
    rotation = rotation * np.sign(np.diag(triangle))
    rotation[:, 0] *= np.linalg.det(rotation)
    return rotation


def _truck(rng: np.random.Generator) -> tuple[list[Primitive], Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """A truck that looks along x, and the lowest and the highest corner of the room on its bed."""
    wheel, half_width = rng.uniform(0.16, 0.22), rng.uniform(0.52, 0.62)
    bed, cab, rail = rng.uniform(1.05, 1.35), rng.uniform(0.4, 0.6), rng.uniform(0.4, 0.5)
    hood = rng.choice([0.0, rng.uniform(0.3, 0.45)])
    floor, wall = 2 * wheel + 0.06, 0.045
    top, low = floor + rail, floor - 0.08
    middle, half_rail = 0.5 * (floor + top), 0.5 * rail
    roof = top + rng.uniform(0.15, 0.35)
    parts = [
        box(_TRUCK, (-0.5 * bed, floor - 0.04, 0), (0.5 * bed, 0.04, half_width)),
        *(box(_TRUCK, (-0.5 * bed, middle, b * (half_width - wall)), (0.5 * bed, half_rail, wall)) for b in (-1, 1)),
        box(_TRUCK, (-bed + wall, middle, 0), (wall, half_rail, half_width)),
        box(_TRUCK, (0.5 * cab, 0.5 * (low + roof), 0), (0.5 * cab, 0.5 * (roof - low), half_width), 0.06),
    ]
    if hood:
        half = np.array([0.5 * hood + 0.05, 0.5 * (floor + rng.uniform(0.5, 0.8) * rail - low), half_width - 0.03])
        parts.append(box(_TRUCK, (cab + half[0] - 0.1, low + half[1], 0), half, 0.06))
    front = cab + hood
    parts.append(box(_TRUCK, (0.5 * (front - bed), low, 0), (0.5 * (front + bed) - 0.03, 0.05, 0.5 * half_width)))
    axles = [-bed + rng.uniform(1.2, 1.6) * wheel, front - rng.uniform(1.2, 1.4) * wheel]
    if rng.random() < 0.4:
        axles.append(axles[0] + 2.2 * wheel)
    thick = rng.uniform(0.06, 0.1)
    for x in axles:
        parts.append(rod(_TRUCK, (x, wheel, -half_width), (x, wheel, half_width), 0.04))
        for b in (-half_width + thick, half_width - thick):
            parts.append(rod(_TRUCK, (x, wheel, b - thick), (x, wheel, b + thick), wheel, rounding=0.04))
    lowest = np.array([-bed + 2 * wall, floor, -half_width + 2 * wall])
    return parts, lowest, np.array([-0.02, floor + rng.uniform(1.5, 2.1) * rail, half_width - 2 * wall])
