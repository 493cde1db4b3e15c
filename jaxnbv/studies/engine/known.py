"""The sampler of a study: by its model, with the shapes that it knows, all of them or a choice."""

import dataclasses
from collections.abc import Callable, Sequence

from jaxnbv.checks import require
from jaxnbv.readers.class_meshes import MeshFile
from jaxnbv.sampler import SurfaceSampler
from jaxnbv.studies.engine.measures import KNOWN
from jaxnbv.surfaces import KnownShapes, ShapeBank, Upright, bank_poses, shape_bank

# So that a number fits into a shape's name too.
_LONGEST = 50


def study_sampler(
    model: str,
    bank: str,
    files: Sequence[MeshFile] = (),
    longest_side: float = 2.5,
    quick: bool = False,
    solid: bool = False,
) -> SurfaceSampler:
    """As `SurfaceSampler.preset`, or for the model `known` the screened one that knows shapes: the meshes of a study,
    upright and of any proportions, or without any those of a bank that ships.

    - `bank`: its name; "" for none.

    **Raises:** `ValueError` for another model, or `known` where there are neither meshes nor a bank.
    """
    if model != KNOWN:
        return SurfaceSampler.preset(model, longest_side, quick, solid=solid)
    plain = SurfaceSampler.preset("screened", longest_side, quick, solid=solid)
    if files:
        names = [_name(files, index) for index in range(len(files))]
        return plain.with_bank(ShapeBank.from_meshes([file.path for file in files], names=names), Upright(by_axis=True))
    require(bool(bank), "there are no known shapes for this study: give another model")
    return plain.with_bank(shape_bank(bank), bank_poses(bank))


def knowing_those(sampler: SurfaceSampler, wanted: Callable[[str], bool]) -> SurfaceSampler:
    """One that knows shapes, of these alone those whose names are wanted; any other as it is."""
    model = sampler.model
    if not isinstance(model, KnownShapes):
        return sampler
    rows = [row for row, name in enumerate(model.bank.names) if wanted(name)]
    if len(rows) == len(model.bank):
        return sampler
    return dataclasses.replace(sampler, model=dataclasses.replace(model, bank=model.bank.chosen(rows)))


def knowing_others(sampler: SurfaceSampler, files: Sequence[MeshFile], index: int) -> SurfaceSampler:
    """One that knows meshes, but for that of a scene; any other as it is."""
    return knowing_those(sampler, lambda name: name != _name(files, index))


def _name(files: Sequence[MeshFile], index: int) -> str:
    return f"{files[index].name[:_LONGEST]} {index}"
