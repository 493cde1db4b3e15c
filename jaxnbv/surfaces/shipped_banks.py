"""Banks of known shapes that ship with jaxnbv: procedural training objects, and some real furniture."""

from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnbv.checks import check_type, require
from jaxnbv.scanning.sdf import UNUSED, ImprintedPyramid, LabelledSolid, Sampled, SignedDistance
from jaxnbv.surfaces.placement import FreeRotation, ShapePoses, Upright
from jaxnbv.surfaces.shape_bank import ShapeBank, encode_names

# Unit of a mesh's stored distances, in the shape's frame. They are clipped to 127 units.
QUANTUM = 0.008
# Upright, with a separate scale for each axis.
_FURNITURE = Upright(by_axis=True)


class ShippedBank(NamedTuple):
    """Description of a shipped bank: `form()` has the PyTree structure of the bank's solids."""

    form: Callable[[], SignedDistance]
    poses: ShapePoses


def _labelled_form() -> LabelledSolid:
    points, numbers = jnp.zeros((1, 3)), jnp.zeros(1)
    shape = points, jnp.eye(3)[None], points, numbers, numbers, numbers
    return LabelledSolid(jnp.full(1, UNUSED), jnp.zeros(1, bool), *shape)


def _pyramid_form() -> ImprintedPyramid:
    one, point = jnp.ones(()), jnp.zeros(2)
    return ImprintedPyramid(jnp.asarray(0), one, one, point, one, one, jnp.eye(3), one, jnp.zeros(3))


def _sampled_form() -> Sampled:
    return Sampled(jnp.zeros((2, 2, 2)), jnp.zeros(3), 1.0, 1.0)


SHIPPED_BANKS = {
    "pyramid": ShippedBank(_pyramid_form, FreeRotation()),
    "truck": ShippedBank(_labelled_form, FreeRotation()),
    "household": ShippedBank(_labelled_form, _FURNITURE),
    "parts": ShippedBank(_labelled_form, Upright(within=0.35, by_axis=True)),
    "heat": ShippedBank(_labelled_form, _FURNITURE),
    "household-real": ShippedBank(_sampled_form, _FURNITURE),
}
"""The banks that ship with jaxnbv, keyed by name."""


def shape_bank(name: str) -> ShapeBank:
    """Load a bank that ships with jaxnbv.

    - `name`: "pyramid", "truck", "household", "parts" or "heat" for procedural objects of the training split;
      "household-real" for furniture modelled by people, credited in `docs/how_to/known_shapes.md`.

    **Raises:** `ValueError` for an unknown name.
    """
    check_type(name, str, "the bank's name")
    choices = ", ".join(SHIPPED_BANKS)
    require(name in SHIPPED_BANKS, f"there is no bank of shapes {name!r}: choose from {choices}, or make one")
    with resources.as_file(resources.files("jaxnbv.surfaces") / "shapes" / f"{name}.npz") as path:
        return read_bank(path, SHIPPED_BANKS[name].form())


def bank_poses(name: str) -> ShapePoses:
    """Return the possible placements of the shapes of a bank that ships with jaxnbv."""
    return SHIPPED_BANKS[name].poses


def read_bank(path: Path, form: SignedDistance) -> ShapeBank:
    """Read a bank that `scripts/make_banks.py` wrote.

    The file stores floating-point numbers in 16 bits, and integers in 8. A distance on a grid is stored as its 8-bit
    difference from the previous node, in units of `QUANTUM`.

    - `form`: a solid with the same PyTree structure as the bank's solids.
    """
    dtypes = {"f": np.float32, "i": np.int32, "b": np.bool_}
    with np.load(path) as archive:
        names = [str(one) for one in archive["names"]]
        *leaves, extremes = (archive[key] for key in sorted(archive.files) if key != "names")
    if isinstance(form, Sampled):
        leaves[0] = QUANTUM * np.cumsum(leaves[0], axis=-1, dtype=np.int8).astype(np.float32)
    arrays = [jnp.asarray(leaf.astype(dtypes[leaf.dtype.kind])) for leaf in (*leaves, extremes)]
    return ShapeBank(jax.tree.unflatten(jax.tree.structure(form), arrays[:-1]), arrays[-1], encode_names(names))
