"""Functions that make the sampler of a study, with or without known shapes, and select its shapes."""

import dataclasses
from collections.abc import Callable, Sequence

from jaxnbv.checks import require
from jaxnbv.readers.class_meshes import MeshFile
from jaxnbv.sampler import SurfaceSampler
from jaxnbv.studies.engine.measures import KNOWN
from jaxnbv.surfaces import KnownShapes, ShapeBank, Upright, bank_poses, shape_bank

# A shape's name is the name of its mesh, cut to this number of characters, and the index of the mesh.
_MAX_NAME_LENGTH = 50


def study_sampler(
    model: str,
    bank: str,
    files: Sequence[MeshFile] = (),
    longest_side: float = 2.5,
    quick: bool = False,
    solid: bool = False,
) -> SurfaceSampler:
    """Return the sampler for a surface model. The model "known" is the screened preset with known shapes.

    - `model`: name of a preset, or "known".
    - `bank`: name of a shipped bank of known shapes; "" for none.
    - `files`: meshes to use as known shapes in place of `bank`. They stay upright, and their proportions may vary.
    - `longest_side`, `quick`, `solid`: arguments of `SurfaceSampler.preset`.

    **Raises:** `ValueError` for an unknown model, or for "known" with neither meshes nor a bank.
    """
    if model != KNOWN:
        return SurfaceSampler.preset(model, longest_side, quick, solid=solid)
    sampler = SurfaceSampler.preset("screened", longest_side, quick, solid=solid)
    if files:
        names = [_name(files, index) for index in range(len(files))]
        bank_of_meshes = ShapeBank.from_meshes([file.path for file in files], names=names)
        return sampler.with_bank(bank_of_meshes, Upright(by_axis=True))
    require(bool(bank), "there are no known shapes for this study: give another model")
    return sampler.with_bank(shape_bank(bank), bank_poses(bank))


def keep_shapes(sampler: SurfaceSampler, is_selected: Callable[[str], bool]) -> SurfaceSampler:
    """Return the sampler with only those of its known shapes, if any, whose names `is_selected` accepts."""
    model = sampler.model
    if not isinstance(model, KnownShapes):
        return sampler
    rows = [row for row, name in enumerate(model.bank.names) if is_selected(name)]
    if len(rows) == len(model.bank):
        return sampler
    return dataclasses.replace(sampler, model=dataclasses.replace(model, bank=model.bank.select(rows)))


def without_own_shape(sampler: SurfaceSampler, files: Sequence[MeshFile], index: int) -> SurfaceSampler:
    """Return the sampler without the known shape made from the mesh `files[index]`, if it has this shape."""
    return keep_shapes(sampler, lambda name: name != _name(files, index))


def _name(files: Sequence[MeshFile], index: int) -> str:
    return f"{files[index].name[:_MAX_NAME_LENGTH]} {index}"
