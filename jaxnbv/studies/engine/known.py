"""Imaginations that know the meshes of a study, or a choice of the shapes that they know."""

import dataclasses
from collections.abc import Callable, Sequence

from jaxnbv.sampler import SurfaceSampler
from jaxnbv.readers.class_meshes import MeshFile
from jaxnbv.surfaces import KnownShapes, ShapeBank, Upright

# So that a number fits into a shape's name too.
_LONGEST = 50


def knowing_meshes(sampler: SurfaceSampler, files: Sequence[MeshFile]) -> SurfaceSampler:
    """One that knows the meshes of a study, upright and of any proportions."""
    names = [_name(files, index) for index in range(len(files))]
    bank = ShapeBank.from_meshes([file.path for file in files], names=names)
    return sampler.with_bank(bank, Upright(by_axis=True))


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
    """One of `knowing_meshes` but for the mesh of a scene; any other as it is."""
    return knowing_those(sampler, lambda name: name != _name(files, index))


def _name(files: Sequence[MeshFile], index: int) -> str:
    return f"{files[index].name[:_LONGEST]} {index}"
