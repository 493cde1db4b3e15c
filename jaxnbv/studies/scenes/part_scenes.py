"""Scenes with one procedural object whose parts are labelled."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from jaxnbv.networks.categories import NUM_PARTS, category_index
from jaxnbv.studies.scenes.labelled import LabelledSolid, assemble, generator
from jaxnbv.studies.scenes.parts import belongings, furniture, vehicles
from jaxnbv.studies.scenes.splits import Split, scene_key

# Each function yields the primitives of a random object. x is forward, y up and z to the right.
_BUILDERS = {
    "airplane": vehicles.airplane,
    "bag": belongings.bag,
    "chair": furniture.chair,
    "earphone": belongings.earphone,
    "guitar": belongings.guitar,
    "lamp": furniture.lamp,
    "laptop": belongings.laptop,
    "motorbike": vehicles.motorbike,
    "mug": belongings.mug,
    "pistol": belongings.pistol,
    "rocket": vehicles.rocket,
    "skateboard": vehicles.skateboard,
    "table": furniture.table,
}

# The names have the order of `networks.CATEGORIES`.
PART_CATEGORIES = tuple(_BUILDERS)

# Objects face along x, as in ShapeNet, and are then rotated about y by at most this angle.
_MAX_ROTATION = np.radians(10.0)


class PartScene(eqx.Module):
    """An object, its category, and which of the fifty parts of ShapeNet-part it has.

    - `solid`: the object. Its labels are indices of the fifty parts.
    - `category`: index in `networks.CATEGORIES`.
    """

    solid: LabelledSolid
    category: Int[Array, ""]
    parts: Bool[Array, "50"]


def part_scene(split: Split, index: int) -> PartScene:
    """Return the scene with this index in a split. It holds a random object with labelled parts.

    The category is `PART_CATEGORIES[index % 13]`. The object stands upright along y and faces x to within 10 degrees.
    Its bounding box is centred and has longest side 2.5. No part is thinner than 0.05. The function does not run under
    `jit`, because it builds the object on the host.

    **Raises:** `ValueError` if the index is negative.
    """
    category, rng = PART_CATEGORIES[index % len(PART_CATEGORIES)], generator(scene_key(0, split, index))
    primitives = list(_BUILDERS[category](rng))
    solid = assemble(primitives, rng.uniform(-_MAX_ROTATION, _MAX_ROTATION))
    parts = np.isin(np.arange(NUM_PARTS), np.asarray(solid.labels))
    return PartScene(solid, jnp.asarray(category_index(category)), jnp.asarray(parts))
