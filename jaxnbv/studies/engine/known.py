"""Imaginations that know the meshes of a study, or a choice of the shapes that they know."""

import dataclasses
from collections.abc import Callable, Sequence

from jaxnbv.imagination import Imagination
from jaxnbv.studies.readers.class_meshes import MeshFile
from jaxnbv.surfaces import KnownShapes, ShapeBank, Upright

# So that a number fits into a shape's name too.
_LONGEST = 50


def knowing_meshes(imagination: Imagination, files: Sequence[MeshFile]) -> Imagination:
    """One that knows the meshes of a study, upright and of any proportions."""
    names = [_name(files, index) for index in range(len(files))]
    bank = ShapeBank.from_meshes([file.path for file in files], names=names)
    return imagination.knowing(bank, Upright(by_axis=True))


def knowing_those(imagination: Imagination, wanted: Callable[[str], bool]) -> Imagination:
    """One that knows shapes, of these alone those whose names are wanted; any other as it is."""
    model = imagination.model
    if not isinstance(model, KnownShapes):
        return imagination
    rows = [row for row, name in enumerate(model.bank.names) if wanted(name)]
    if len(rows) == len(model.bank):
        return imagination
    return dataclasses.replace(imagination, model=dataclasses.replace(model, bank=model.bank.chosen(rows)))


def knowing_others(imagination: Imagination, files: Sequence[MeshFile], index: int) -> Imagination:
    """One of `knowing_meshes` but for the mesh of a scene; any other as it is."""
    return knowing_those(imagination, lambda name: name != _name(files, index))


def _name(files: Sequence[MeshFile], index: int) -> str:
    return f"{files[index].name[:_LONGEST]} {index}"
