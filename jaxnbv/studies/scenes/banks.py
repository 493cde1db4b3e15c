"""Banks of known shapes: objects of the training split of the procedural scenes, and a few real ones."""

from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxnbv.checks import check_type, require
from jaxnbv.scanning.sdf import Sampled, SignedDistance
from jaxnbv.studies.scenes.heat_objects import FIRST_TRAINING, HEAT_OBJECTS, heat_scene
from jaxnbv.studies.scenes.household import HOUSEHOLD, household_scene
from jaxnbv.studies.scenes.parts import PART_CATEGORIES, part_scene
from jaxnbv.studies.scenes.patterns import PATTERNS
from jaxnbv.studies.scenes.pyramid import pyramid_scene
from jaxnbv.studies.scenes.splits import Split
from jaxnbv.studies.scenes.truck import truck_scene
from jaxnbv.surfaces import FreeRotation, ShapeBank, ShapePoses, Upright
from jaxnbv.surfaces.shape_bank import encoded

# One unit of the stored distances of a mesh, which are clipped to 127 of them.
_QUANTUM = 0.008
# Upright, of any proportions.
_FURNITURE = Upright(by_axis=True)


class Kind(NamedTuple):
    """A bank of procedural objects.

    - `number`: how many. `names`: of the kinds of object, which take turns.
    - `shape`: the object of a number, in the training split.
    - `poses`: how such objects stand in a scene.
    """

    number: int
    names: tuple[str, ...]
    shape: Callable[[int], SignedDistance]
    poses: ShapePoses


def _heated(index: int) -> SignedDistance:
    surface: Any = heat_scene(FIRST_TRAINING + index, turned=False).surface
    return surface.sdf


KINDS = {
    "pyramid": Kind(1024, PATTERNS, lambda i: pyramid_scene(Split.TRAIN, i, turned=False), FreeRotation()),
    "truck": Kind(512, HOUSEHOLD, lambda i: truck_scene(Split.TRAIN, i, turned=False), FreeRotation()),
    "household": Kind(512, HOUSEHOLD, lambda i: household_scene(Split.TRAIN, i, turned=False), _FURNITURE),
    "parts": Kind(520, PART_CATEGORIES, lambda i: part_scene(Split.TRAIN, i).solid, Upright(within=0.35, by_axis=True)),
    "heat": Kind(256, HEAT_OBJECTS, _heated, _FURNITURE),
}
"""The banks of procedural objects, by name."""

REAL = "household-real"
BANKS = (*KINDS, REAL)
"""The names of the banks that ship."""


def shape_bank(name: str) -> ShapeBank:
    """A bank that ships.

    - `name`: of `KINDS`, procedural objects of the training split; or `household-real`, pieces of furniture that were
      modelled by people, see its credits in the README.

    **Raises:** `ValueError` for another name.
    """
    check_type(name, str, "the bank's name")
    require(name in BANKS, f"there is no bank of shapes {name!r}: choose from {', '.join(BANKS)}, or make one")
    with resources.as_file(resources.files("jaxnbv.studies.scenes") / "shapes" / f"{name}.npz") as path:
        return read_bank(path, name)


def bank_poses(name: str) -> ShapePoses:
    """How the shapes of a bank that ships stand in a scene."""
    return KINDS[name].poses if name in KINDS else _FURNITURE


def made_bank(name: str) -> ShapeBank:
    """A bank of `KINDS`, made anew."""
    kind = KINDS[name]
    labels = [kind.names[index % len(kind.names)] for index in range(kind.number)]
    names = [f"{label} {index}" for index, label in enumerate(labels)]
    return ShapeBank.of([kind.shape(index) for index in range(kind.number)], names)


def write_bank(path: Path, bank: ShapeBank) -> None:
    """Numbers are rounded to sixteen bits, distances on grids to eight."""
    solids, extremes = bank.shapes
    if isinstance(solids, Sampled):
        steps = np.clip(np.round(np.asarray(solids.values) / _QUANTUM), -127, 127).astype(np.int8)
        # Neighbours are alike, so that their differences take less room.
        solids = eqx.tree_at(lambda s: s.values, solids, np.diff(steps, axis=-1, prepend=np.int8(0)))
    leaves = [_rounded(np.asarray(leaf)) for leaf in (*jax.tree.leaves(solids), extremes)]
    arrays: dict[str, Any] = {f"{index:02d}": leaf for index, leaf in enumerate(leaves)}
    np.savez_compressed(path, names=np.array(bank.names), **arrays)


def read_bank(path: Path, name: str) -> ShapeBank:
    """What `write_bank` wrote of the bank of this name."""
    with np.load(path) as stored:
        names = tuple(str(one) for one in stored["names"])
        *leaves, extremes = (_restored(stored[key]) for key in sorted(stored.files) if key != "names")
    if name == REAL:
        values, *others = leaves
        solids: SignedDistance = Sampled(jnp.zeros((2, 2, 2)), jnp.zeros(3), 1.0, 1.0)
        leaves = [_QUANTUM * np.cumsum(values, axis=-1, dtype=np.int8).astype(np.float32), *others]
    else:
        solids = KINDS[name].shape(0)
    structure = jax.tree.structure(solids)
    return ShapeBank(
        jax.tree.unflatten(structure, [jnp.asarray(leaf) for leaf in leaves]), jnp.asarray(extremes), encoded(names)
    )


# What is stored, and what it becomes again, by NumPy's kind; truths stay.
_STORED = {"f": (np.float16, np.float32), "i": (np.int8, np.int32)}


def _rounded(array: np.ndarray) -> np.ndarray:
    return array.astype(_STORED[array.dtype.kind][0]) if array.dtype.kind in _STORED else array


def _restored(array: np.ndarray) -> np.ndarray:
    return array.astype(_STORED[array.dtype.kind][1]) if array.dtype.kind in _STORED else array
