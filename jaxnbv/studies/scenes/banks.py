"""Banks of known shapes that ship: objects of the training split of the procedural scenes, and a few real ones."""

from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnbv.checks import check_type, require
from jaxnbv.scanning.sdf import Sampled, SignedDistance
from jaxnbv.studies.scenes.heat_objects import FIRST_TRAINING, heat_scene
from jaxnbv.studies.scenes.household import household_scene
from jaxnbv.studies.scenes.part_scenes import part_scene
from jaxnbv.studies.scenes.pyramid import pyramid_scene
from jaxnbv.studies.scenes.splits import Split
from jaxnbv.studies.scenes.truck import truck_scene
from jaxnbv.surfaces import FreeRotation, ShapeBank, ShapePoses, Upright
from jaxnbv.surfaces.shape_bank import encoded

# One unit of the stored distances of a mesh, which are clipped to 127 of them.
QUANTUM = 0.008
# Upright, of any proportions.
_FURNITURE = Upright(by_axis=True)


class Kind(NamedTuple):
    """A bank that ships.

    - `shape`: the object of a number, in the training split; of real objects one that only has their form.
    - `poses`: how such objects stand in a scene.
    """

    shape: Callable[[int], SignedDistance]
    poses: ShapePoses


def _heated(index: int) -> SignedDistance:
    surface: Any = heat_scene(FIRST_TRAINING + index, turned=False).surface
    return surface.sdf


KINDS = {
    "pyramid": Kind(lambda i: pyramid_scene(Split.TRAIN, i, turned=False), FreeRotation()),
    "truck": Kind(lambda i: truck_scene(Split.TRAIN, i, turned=False), FreeRotation()),
    "household": Kind(lambda i: household_scene(Split.TRAIN, i, turned=False), _FURNITURE),
    "parts": Kind(lambda i: part_scene(Split.TRAIN, i).solid, Upright(within=0.35, by_axis=True)),
    "heat": Kind(_heated, _FURNITURE),
    "household-real": Kind(lambda i: Sampled(jnp.zeros((2, 2, 2)), jnp.zeros(3), 1.0, 1.0), _FURNITURE),
}
"""The banks that ship, by name."""


def shape_bank(name: str) -> ShapeBank:
    """A bank that ships.

    - `name`: "pyramid", "truck", "household", "parts" or "heat", procedural objects of the training split; or
      "household-real", pieces of furniture that were modelled by people, credited in `docs/how_to/known_shapes.md`.

    **Raises:** `ValueError` for another name.
    """
    check_type(name, str, "the bank's name")
    require(name in KINDS, f"there is no bank of shapes {name!r}: choose from {', '.join(KINDS)}, or make one")
    with resources.as_file(resources.files("jaxnbv.studies.scenes") / "shapes" / f"{name}.npz") as path:
        return read_bank(path, KINDS[name].shape(0))


def bank_poses(name: str) -> ShapePoses:
    """How the shapes of a bank that ships stand in a scene."""
    return KINDS[name].poses


def read_bank(path: Path, like: SignedDistance) -> ShapeBank:
    """What `scripts/make_banks.py` wrote of solids of this form: numbers in sixteen bits, whole ones and distances on
    grids, as differences of neighbours in units of `QUANTUM`, in eight."""
    wide = {"f": np.float32, "i": np.int32, "b": np.bool_}
    with np.load(path) as stored:
        names = [str(one) for one in stored["names"]]
        *leaves, extremes = (stored[key] for key in sorted(stored.files) if key != "names")
    if isinstance(like, Sampled):
        leaves[0] = QUANTUM * np.cumsum(leaves[0], axis=-1, dtype=np.int8).astype(np.float32)
    arrays = [jnp.asarray(leaf.astype(wide[leaf.dtype.kind])) for leaf in (*leaves, extremes)]
    return ShapeBank(jax.tree.unflatten(jax.tree.structure(like), arrays[:-1]), arrays[-1], encoded(names))
