"""A folder of meshes as the scenes of a study."""

import dataclasses
import os
from abc import abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import trimesh

from jaxnbv.checks import require
from jaxnbv.imagination import Imagination
from jaxnbv.scanning import TriangleMesh, load_mesh
from jaxnbv.studies.engine.measures import KNOWN
from jaxnbv.studies.engine.study import Scene, Study
from jaxnbv.studies.readers.class_meshes import is_mesh_file
from jaxnbv.surfaces import KnownShapes, ShapeBank, Upright

_File = TypeVar("_File")
# So that a number fits into a shape's name too.
_LONGEST = 50


def mesh_files(folder: str | Path) -> tuple[str, ...]:
    """The mesh files in a folder, sorted: those whose name ends as a format that trimesh reads.

    **Raises:** `ValueError` if there is no such folder, or no mesh in it.
    """
    folder = Path(folder)
    require(os.path.isdir(folder), f"there is no folder {folder}: give one that holds mesh files")
    found = tuple(str(file) for file in sorted(folder.iterdir()) if is_mesh_file(file))
    formats = ", ".join(sorted(trimesh.available_formats()))
    require(len(found) > 0, f"the folder {folder} holds no mesh: its files must end in {formats}")
    return found


def numbered(files: Sequence[_File], index: int) -> _File:
    """The file of a scene.

    **Raises:** `ValueError` if there is none of this index.
    """
    require(
        0 <= index < len(files),
        f"there is no scene {index}: the study has {len(files)} meshes, counted from 0; run as many scenes",
    )
    return files[index]


def knowing_meshes(imagination: Imagination, files: Sequence[str]) -> Imagination:
    """One that knows the meshes of a study, upright and of any proportions."""
    names = [f"{Path(file).stem[:_LONGEST]} {index}" for index, file in enumerate(files)]
    return imagination.knowing(ShapeBank.from_meshes(files, names=names), Upright(by_axis=True))


def knowing_those(imagination: Imagination, wanted: Callable[[str], bool]) -> Imagination:
    """One that knows shapes, of these alone those whose names are wanted; any other as it is."""
    model = imagination.model
    if not isinstance(model, KnownShapes):
        return imagination
    rows = [row for row, name in enumerate(model.bank.names) if wanted(name)]
    return dataclasses.replace(imagination, model=dataclasses.replace(model, bank=model.bank.chosen(rows)))


def knowing_others(imagination: Imagination, index: int) -> Imagination:
    """One of `knowing_meshes` but for the mesh of a scene; any other as it is."""
    return knowing_those(imagination, lambda name: name.rpartition(" ")[2] != str(index))


def as_mesh_files(meshes: str | Path | Sequence[str] | None) -> tuple[str, ...]:
    """A folder's `mesh_files`, files as they are, or none."""
    return mesh_files(meshes) if isinstance(meshes, str | Path) else tuple(meshes or ())


class MeshStudy(Study):
    """A study of procedural objects, or of meshes. Settings as of `Study`, and

    - `meshes`: a folder of them, or their files, one a scene; without any, scenes are procedural.
    """

    meshes: tuple[str, ...] = eqx.field(static=True, default=(), converter=as_mesh_files)

    @classmethod
    def configured(cls, model: str, views: int, quick: bool, **options: Any) -> dict[str, Study]:
        """
        - `meshes`: a folder of them. By the model `known` each object is planned by who has seen all others.
        """
        if "meshes" in options and model == KNOWN:
            files = as_mesh_files(options["meshes"])
            options |= {"meshes": files, "imagination": knowing_meshes(cls.imagined("screened", quick=quick), files)}
        return super().configured(model, views, quick, **options)

    @property
    def num_scenes(self) -> int | None:
        return len(self.meshes) or None

    def scene(self, index: int) -> Scene:
        """An object; a mesh has a longest side of 2.5.

        **Raises:** `ValueError` if there is no mesh of this index, or it cannot be read.
        """
        if not self.meshes:
            return self.procedural(index)
        file = numbered(self.meshes, index)
        mesh = load_mesh(file)
        return Scene(index, Path(file).name, mesh, self.task_of(mesh, index))

    @abstractmethod
    def procedural(self, index: int) -> Scene:
        """A scene without meshes."""

    def task_of(self, mesh: TriangleMesh, index: int) -> Any:
        """The task of a scene of a mesh."""
        return None

    def imagination_of(self, scene: Scene) -> Imagination:
        """Who has seen all meshes but that of the scene, or what the study knows."""
        return knowing_others(self.imagination, scene.index) if self.meshes else self.imagination
