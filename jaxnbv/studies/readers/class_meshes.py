"""Meshes by class in a local folder, as data sets lay them out."""

import itertools
import os
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

import trimesh

from jaxnbv.checks import checked, require, shown
from jaxnbv.networks.categories import CATEGORIES
from jaxnbv.scanning import TriangleMesh, load_mesh

_T = TypeVar("_T")


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
        require(os.path.isfile(Path(self.path)), f"there is no file {self.path}: unpack the data set again")
        return load_mesh(self.path, self.up)


class _Layout(NamedTuple):
    """What lies in the folder of a class.

    - `files`: a pattern of its meshes; {name} is the folder's own, {split} "train" or "test".
    - `up`: their axis that is upward.
    """

    files: str
    up: str = "y"


_LAYOUTS = {
    "ModelNet": _Layout("{split}/{name}_[0-9]*.off", up="z"),
    "OmniObject3D": _Layout("*/Scan/Scan.obj"),
    "ShapeNet v2": _Layout("*/models/model_normalized.obj"),
    "ShapeNet v1": _Layout("*/model.obj"),
    "split": _Layout("{split}/**/*"),
    "any": _Layout("**/*"),
}
_SPLITS = ("train", "test")
# Categories of ShapeNet lie in folders of WordNet's numbers.
_SYNSETS = {category.name: category.synset for category in CATEGORIES}


def is_mesh_file(path: Path) -> bool:
    """Whether a file's name ends as a format that trimesh reads."""
    return path.suffix[1:].lower() in trimesh.available_formats() and path.is_file()


def taking_turns(groups: Iterable[Sequence[_T]]) -> list[_T]:
    """The first of each group, then the second of each that has one, and so on."""
    turns = itertools.chain.from_iterable(itertools.zip_longest(*groups))
    return [one for one in turns if one is not None]


@checked
def class_meshes(folder: str | Path, classes: Sequence[str], split: str = "test") -> tuple[MeshFile, ...]:
    """The meshes in a folder `class/.../name` for those of the classes that have one, labelled by their place in
    `classes`; these take turns. Other folders are passed over.

    Names of classes may be written with underscores. How a class is laid out is seen from its files: as in ModelNet,
    OmniObject3D or ShapeNet (whose folders are numbers, which can be given as names too), or in any other way. Where
    there are splits the meshes are those of `split`. Folders of objects without a mesh are named by a `UserWarning`.

    **Raises:** `ValueError` if there is no such folder, none of a class, or one without a mesh; and unless classes and
    split are names.
    """
    folder = Path(folder)
    named = isinstance(classes, list | tuple) and all(isinstance(name, str) for name in classes)
    require(named, f"the classes are {shown(classes)}: give a list of names")
    require(split in _SPLITS, f"there is no split {shown(split)}: choose from {', '.join(_SPLITS)}")
    require(
        os.path.isdir(folder), f"there is no folder {folder}: give one that holds a folder of meshes for each class"
    )
    folder = folder / "raw_scans" if (folder / "raw_scans").is_dir() else folder
    there = {_plain(path.name): path for path in sorted(folder.iterdir()) if path.is_dir()}
    found = [(label, there.get(_plain(name), there.get(_SYNSETS.get(name, "")))) for label, name in enumerate(classes)]
    groups = [_of_class(path, label, split) for label, path in found if path is not None]
    require(len(groups) > 0, f"the folder {folder} has none of the folders {', '.join(classes)}: give one that has")
    return tuple(taking_turns(groups))


def _plain(name: str) -> str:
    return name.lower().replace("_", " ")


def _of_class(folder: Path, label: int, split: str) -> list[MeshFile]:
    for layout in _LAYOUTS.values():
        inside = sorted(folder.glob(layout.files.format(name=folder.name, split=split)))
        files = [file for file in inside if is_mesh_file(file)]
        if files:
            break
    require(len(files) > 0, f"the folder {folder} holds no mesh of the split {split}: unpack it again, or take it away")
    # Else each object has a folder, which names it.
    if not layout.files.startswith("*/"):
        return [MeshFile(label, file.stem, str(file), layout.up) for file in files]
    named = {file.relative_to(folder).parts[0]: file for file in files}
    absent = [path.name for path in sorted(folder.iterdir()) if path.is_dir() and path.name not in named]
    if absent:
        warnings.warn(
            f"{len(absent)} of the {len(absent) + len(named)} objects of {folder} have no mesh and are left out: "
            f"{', '.join(absent[:3])}{', ...' if len(absent) > 3 else ''}; unpack the data set again if you want them",
            stacklevel=3,
        )
    return [MeshFile(label, name, str(file), layout.up) for name, file in named.items()]
