"""Which surfaces are held possible: the paper's, and those that the command line and the studies use by default."""

import dataclasses
import math
from typing import NamedTuple

import jax.numpy as jnp

from jaxnbv.checks import checked, require
from jaxnbv.cli.model_name import ModelName as ModelName
from jaxnbv.geometry.volume import Box, Volume
from jaxnbv.scanning import Carving
from jaxnbv.surfaces import (
    GeometricSPSR,
    OnSurface,
    OutsideBoundary,
    ScreenedSPSR,
    SeenEmpty,
    SurfaceModel,
)


class Imagination(NamedTuple):
    """A distribution over surfaces, and what its samples are carved by; both as `Planner` takes them."""

    model: SurfaceModel
    carving: Carving | None


@checked
def imagination(
    name: ModelName | str,
    longest_side: float = 2.5,
    quick: bool = False,
    volume: Volume | None = None,
    solid: bool = False,
    lengthscale: float | None = None,
) -> Imagination:
    """The surfaces of a name, for an object whose box has this longest side, in scene units.

    - `screened`: the default `ScreenedSPSR`, whose lengths are taken in proportion to the longest side and for which
      the boundary of the volume is outside; carved, so that nothing is inside where the sensor saw empty space, nor
      outside the volume.
    - `paper`: the published model at its published values, which conditions on normals alone; not carved.
    - `quick`: with fewer frequencies.
    - `volume`: by default the cube of the longest side about the origin.
    - `solid`: for a body that is nowhere thin, such as the pyramid: its hidden side is as large as the one that was
      seen, so that nothing follows for the space beside what was seen empty (`SeenEmpty`).
    - `lengthscale`: that of detail, in place of the model's own short one; see `GeometricSPSR`.

    **Raises:** `ValueError` for another name, or a longest side or lengthscale that is not positive.
    """
    require(longest_side > 0, f"the longest side is {longest_side}; it must be positive")
    require(
        lengthscale is None or 0 < lengthscale < math.inf,
        f"the lengthscale is {lengthscale}; it must be positive and finite",
    )
    known = ", ".join(ModelName)
    require(name in [*ModelName], f"there is no model {name!r}: choose from {known}")
    if name == ModelName.PAPER:
        usual_one = GeometricSPSR(0.015, truncation=20) if quick else GeometricSPSR()
        return Imagination(
            usual_one if lengthscale is None else dataclasses.replace(usual_one, lengthscale=lengthscale), None
        )
    volume = Box.cube(longest_side) if volume is None else volume
    scale, usual = longest_side / 2.5, ScreenedSPSR()
    lengthscales = scale * (usual.base.lengthscale + (jnp.array([0.005, 0.0]) if quick else 0.0))
    if lengthscale is not None:
        lengthscales = lengthscales.at[0].set(lengthscale)
    # Shorter scales need more frequencies, but time and memory grow with their cube.
    truncation = min(round((20 if quick else usual.base.truncation) / scale), 30 if quick else 48)
    base = GeometricSPSR(lengthscales, usual.base.variance, truncation)
    values = (OutsideBoundary(volume), OnSurface(), *(() if solid else (SeenEmpty(),)))
    return Imagination(ScreenedSPSR(base, values, reach=scale * usual.reach), Carving(volume))
