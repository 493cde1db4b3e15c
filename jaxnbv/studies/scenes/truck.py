"""Trucks whose open bed carries an object of one of ten classes. Only the cargo tells the class."""

from functools import partial

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxnbv.studies.scenes import labelled
from jaxnbv.studies.scenes.class_object import SolidObject
from jaxnbv.studies.scenes.framing import Framing
from jaxnbv.studies.scenes.household import BUILDERS, HOUSEHOLD
from jaxnbv.studies.scenes.labelled import CAPACITY, Primitive, bounds, fit, generator, move, rotation_about, union
from jaxnbv.studies.scenes.splits import Split, scene_key

# Primitives of the truck have the label 0, because only the cargo tells the class.
box, rod = (partial(make, 0) for make in (labelled.box, labelled.rod))


def truck_scene(split: Split, index: int, framing: Framing = Framing.CLOSE_UP, is_rotated: bool = True) -> SolidObject:
    """Return the loaded truck with this index in a split. The cargo's class is `HOUSEHOLD[index % 10]`.

    The cargo is rotated about the vertical by a random angle and scaled to fill the bed. The loaded truck has a random
    rotation if `is_rotated`, else it stands upright along y and faces x. Its bounding box is centred in the scene. The
    truck is built on the host, so the function does not run under `jit`.

    **Raises:** `ValueError` if the index is negative.
    """
    label, rng = index % len(HOUSEHOLD), generator(scene_key(5, split, index))
    truck, bed = _truck(rng)
    cargo_rotation = rotation_about((0.0, 1.0, 0.0), rng.uniform(-np.pi, np.pi))
    cargo = [move(p, rotation=cargo_rotation) for p in BUILDERS[HOUSEHOLD[label]](rng)]
    scale, offset = placement_on_bed(bed, bounds(cargo), rng)
    cargo = [move(p, scale, offset=offset) for p in cargo]
    rotation = random_rotation(rng) if is_rotated else np.eye(3)
    primitives = fit([move(p, rotation=rotation) for p in truck + cargo], framing.longest_side)
    return SolidObject(solid=union(primitives, 2 * CAPACITY), label=jnp.asarray(label))


def placement_on_bed(
    bed: Float[np.ndarray, "2 3"], cargo: Float[np.ndarray, "2 3"], rng: np.random.Generator
) -> tuple[float, Float[np.ndarray, "3"]]:
    """Return a scale and a shift that place a cargo at a random position on the floor of a bed.

    The scale is a random fraction (85 to 95 %) of the largest scale at which the cargo fits above the bed.

    - `bed`, `cargo`: bounding boxes (lowest and highest corner) of the space above the bed and of the cargo.
    """
    side, size = np.diff(bed, axis=0)[0], np.diff(cargo, axis=0)[0]
    scale = float((rng.uniform(0.85, 0.95) * side / size).min())
    corner = bed[0] + (side - scale * size) * np.array([rng.random(), 0.0, rng.random()])
    return scale, corner - scale * cargo[0]


def random_rotation(rng: np.random.Generator) -> Float[np.ndarray, "3 3"]:
    """Draw a uniformly random rotation, by QR decomposition of a Gaussian matrix."""
    rotation, triangle = np.linalg.qr(rng.normal(size=(3, 3)))
    rotation = rotation * np.sign(np.diag(triangle))
    rotation[:, 0] *= np.linalg.det(rotation)
    return rotation


def _truck(rng: np.random.Generator) -> tuple[list[Primitive], Float[np.ndarray, "2 3"]]:
    """Return the primitives of a truck that faces x, and the corners of the space above its bed."""
    wheel, half_width = rng.uniform(0.16, 0.22), rng.uniform(0.52, 0.62)
    bed, cab, rail = rng.uniform(1.05, 1.35), rng.uniform(0.4, 0.6), rng.uniform(0.4, 0.5)
    hood = rng.choice([0.0, rng.uniform(0.3, 0.45)])
    floor, wall = 2 * wheel + 0.06, 0.045
    top, low = floor + rail, floor - 0.08
    middle, half_rail = 0.5 * (floor + top), 0.5 * rail
    roof = top + rng.uniform(0.15, 0.35)
    parts = [
        box((-0.5 * bed, floor - 0.04, 0), (0.5 * bed, 0.04, half_width)),
        *(box((-0.5 * bed, middle, b * (half_width - wall)), (0.5 * bed, half_rail, wall)) for b in (-1, 1)),
        box((-bed + wall, middle, 0), (wall, half_rail, half_width)),
        box((0.5 * cab, 0.5 * (low + roof), 0), (0.5 * cab, 0.5 * (roof - low), half_width), 0.06),
    ]
    if hood:
        half = np.array([0.5 * hood + 0.05, 0.5 * (floor + rng.uniform(0.5, 0.8) * rail - low), half_width - 0.03])
        parts.append(box((cab + half[0] - 0.1, low + half[1], 0), half, 0.06))
    front = cab + hood
    parts.append(box((0.5 * (front - bed), low, 0), (0.5 * (front + bed) - 0.03, 0.05, 0.5 * half_width)))
    axles = [-bed + rng.uniform(1.2, 1.6) * wheel, front - rng.uniform(1.2, 1.4) * wheel]
    if rng.random() < 0.4:
        axles.append(axles[0] + 2.2 * wheel)
    thick = rng.uniform(0.06, 0.1)
    for x in axles:
        parts.append(rod((x, wheel, -half_width), (x, wheel, half_width), 0.04))
        for b in (-half_width + thick, half_width - thick):
            parts.append(rod((x, wheel, b - thick), (x, wheel, b + thick), wheel, rounding=0.04))
    lowest = -bed + 2 * wall, floor, -half_width + 2 * wall
    highest = -0.02, floor + rng.uniform(1.5, 2.1) * rail, half_width - 2 * wall
    return parts, np.array([lowest, highest])
