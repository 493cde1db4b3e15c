"""Meshes by class in a local folder, as data sets lay them out."""

import itertools
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

import trimesh

from jaxnbv.checks import InputError, checked, require, shown
from jaxnbv.networks.categories import CATEGORIES
from jaxnbv.scanning import TriangleMesh, load_mesh

_T = TypeVar("_T")
# Patterns of the meshes in the folder of a class, with their axis that is upward; {name} is the folder's own.
_LAYOUTS = {
    "test/{name}_[0-9]*.off": "z",  # ModelNet
    "*/Scan/Scan.obj": "y",  # OmniObject3D
    "*/models/model_normalized.obj": "y",  # ShapeNet v2
    "*/model.obj": "y",  # ShapeNet v1
    "test/**/*": "y",
    "**/*": "y",
}
# Categories of ShapeNet lie in folders of WordNet's numbers.
_SYNSETS = {category.name: category.synset for category in CATEGORIES}


class MeshFile(NamedTuple):
    """Where a mesh lies, and what is known of it without reading it.

    - `label`: the place of its class; `name`: the object's.
    - `path`: of the file.
    - `up`: the file's axis that is upward, see `Frame`.
    """

    label: int
    name: str
    path: str
    up: str = "y"

    def read(self) -> TriangleMesh:
        """The mesh in scene coordinates, upright and with a longest side of 2.5, see `load_mesh`.

        **Raises:** `ValueError` if the file is missing or damaged.
        """
        return load_mesh(self.path, self.up)


def taking_turns(groups: Iterable[Sequence[_T]]) -> list[_T]:
    """The first of each group, then the second of each that has one, and so on."""
    turns = itertools.chain.from_iterable(itertools.zip_longest(*groups))
    return [one for one in turns if one is not None]


@checked
def class_meshes(folder: str | Path, classes: Sequence[str]) -> tuple[MeshFile, ...]:
    """The meshes in a folder `class/.../name` for those of the classes that have one, labelled by their place in
    `classes`; these take turns. Other folders are passed over.

    Names of classes may be written with underscores. How a class is laid out is seen from its files: as in ModelNet,
    OmniObject3D or ShapeNet (whose folders are numbers, which can be given as names too), or in any other way. Where
    there is a split `test` the meshes are its.

    **Raises:** `ValueError` if there is no such folder, none of a class, or one without a mesh; and unless classes are
    names.
    """
    named = isinstance(classes, list | tuple) and all(isinstance(name, str) for name in classes)
    require(named, f"the classes are {shown(classes)}: give a list of names")
    folder = _existing(folder)
    folder = folder / "raw_scans" if (folder / "raw_scans").is_dir() else folder
    there = {_plain(path.name): path for path in sorted(folder.iterdir()) if path.is_dir()}
    found = [(label, there.get(_plain(name), there.get(_SYNSETS.get(name, "")))) for label, name in enumerate(classes)]
    groups = [_of_class(path, label) for label, path in found if path is not None]
    require(len(groups) > 0, f"the folder {folder} has none of the folders {', '.join(classes)}: give one that has")
    return tuple(taking_turns(groups))


def _plain(name: str) -> str:
    return name.lower().replace("_", " ")


def mesh_files(folder: str | Path) -> tuple[MeshFile, ...]:
    """The meshes in a folder, at any depth and sorted, all of the label 0.

    **Raises:** `ValueError` if there is no such folder, or no mesh in it.
    """
    return tuple(_of_class(_existing(folder), 0))


def _existing(folder: str | Path) -> Path:
    require(os.path.isdir(folder), f"there is no folder {folder}: give one that holds meshes")
    return Path(folder)


def _of_class(folder: Path, label: int) -> list[MeshFile]:
    formats = trimesh.available_formats()
    for pattern, up in _LAYOUTS.items():
        found = sorted(folder.glob(pattern.format(name=folder.name)))
        files = [file for file in found if file.suffix[1:].lower() in formats and file.is_file()]
        if files:
            # Where each object has a folder, this names it.
            names = [file.relative_to(folder).parts[0] if pattern.startswith("*/") else file.stem for file in files]
            return [MeshFile(label, name, str(file), up) for name, file in zip(names, files, strict=True)]
    raise InputError(f"the folder {folder} holds no mesh: its files must end in {', '.join(sorted(formats))}")
