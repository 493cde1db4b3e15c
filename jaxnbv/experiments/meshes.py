"""A folder of meshes as the scenes of a study."""

import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TypeVar

import trimesh

from jaxnbv.checks import require
from jaxnbv.scanning import TriangleMesh, load_mesh

_T = TypeVar("_T")


def mesh_files(folder: str | Path) -> tuple[str, ...]:
    """The mesh files in a folder, sorted: those whose name ends as a format that trimesh reads.

    **Raises:** `ValueError` if there is no such folder, or no mesh in it.
    """
    folder = Path(folder)
    require(folder.is_dir(), f"there is no folder {folder}: give one that holds mesh files")
    found = tuple(str(file) for file in sorted(folder.iterdir()) if is_mesh_file(file))
    formats = ", ".join(sorted(trimesh.available_formats()))
    require(len(found) > 0, f"the folder {folder} holds no mesh: its files must end in {formats}")
    return found


def is_mesh_file(path: Path) -> bool:
    """Whether a file's name ends as a format that trimesh reads."""
    return path.suffix[1:].lower() in trimesh.available_formats() and path.is_file()


def taking_turns(groups: Iterable[Sequence[_T]]) -> list[_T]:
    """The first of each group, then the second of each that has one, and so on."""
    turns = itertools.chain.from_iterable(itertools.zip_longest(*groups))
    return [one for one in turns if one is not None]


def class_meshes(folder: str | Path, classes: Sequence[str]) -> tuple[tuple[int, str], ...]:
    """The class and the file of each mesh in a folder `class/.../name` for some of the classes; these take turns.

    Names of classes may be written with underscores. Where a class is split as ModelNet is, in `train` and `test`, the
    meshes are those of `test`. Other folders are passed over.

    **Raises:** `ValueError` if there is no such folder, none of a class, or one without a mesh.
    """
    folder = Path(folder)
    require(folder.is_dir(), f"there is no folder {folder}: give one that holds a folder of meshes for each class")
    found = {path.name.lower().replace("_", " "): path for path in sorted(folder.iterdir()) if path.is_dir()}
    known = [(label, found[name]) for label, name in enumerate(classes) if name in found]
    require(len(known) > 0, f"the folder {folder} has none of the folders {', '.join(classes)}: give one that has")
    meshes = []
    for label, of_class in known:
        split = of_class / "test"
        inside = sorted((split if split.is_dir() else of_class).rglob("*"))
        files = [str(file) for file in inside if is_mesh_file(file)]
        require(len(files) > 0, f"the folder {of_class} holds no mesh: unpack it again, or take it away")
        meshes.append([(label, file) for file in files])
    return tuple(taking_turns(meshes))


def numbered_mesh(files: Sequence[str], index: int) -> TriangleMesh:
    """The mesh of a scene, of longest side 2.5.

    **Raises:** `ValueError` if there is no mesh of this index, or it cannot be read.
    """
    require(
        0 <= index < len(files),
        f"there is no scene {index}: the study has {len(files)} meshes, counted from 0; run as many scenes",
    )
    return load_mesh(files[index])


def as_mesh_files(meshes: str | Path | Sequence[str] | None) -> tuple[str, ...]:
    """A folder's `mesh_files`, files as they are, or none."""
    return mesh_files(meshes) if isinstance(meshes, str | Path) else tuple(meshes or ())
