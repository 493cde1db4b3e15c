"""Lists and reads the meshes of each class in a local folder, in the layouts of common data sets."""

import itertools
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

import trimesh

from jaxnbv.checks import InputError, checked, require, short_text
from jaxnbv.networks.categories import CATEGORIES
from jaxnbv.scanning import TriangleMesh, load_mesh

_T = TypeVar("_T")
# Layouts of a class's folder, in the order in which they are tried: pattern of the mesh files, and up axis in them.
# {name} stands for the name of the folder.
_LAYOUTS = {
    "test/{name}_[0-9]*.off": "z",  # ModelNet
    "*/Scan/Scan.obj": "y",  # OmniObject3D
    "*/models/model_normalized.obj": "y",  # ShapeNet v2
    "*/model.obj": "y",  # ShapeNet v1
    "test/**/*": "y",
    "**/*": "y",
}
# ShapeNet names the folder of a category by its WordNet number.
_SYNSETS = {category.name: category.synset for category in CATEGORIES}


class MeshFile(NamedTuple):
    """A mesh file of one object: class index (`label`), name, path, and upward axis `up` (see `Frame`)."""

    label: int
    name: str
    path: str
    up: str = "y"

    def read(self) -> TriangleMesh:
        """Read the mesh into scene coordinates, upright and with a longest side of 2.5, see `load_mesh`.

        **Raises:** `ValueError` if the file is missing or damaged.
        """
        return load_mesh(self.path, self.up)


def interleave(groups: Iterable[Sequence[_T]]) -> list[_T]:
    """List the first item of each group, then the second item of each group, and so on."""
    rounds = itertools.chain.from_iterable(itertools.zip_longest(*groups))
    return [item for item in rounds if item is not None]


@checked
def class_meshes(folder: str | Path, classes: Sequence[str]) -> tuple[MeshFile, ...]:
    """List the mesh files in a folder that has one subfolder for each class, named after the class.

    The list has the first object of each class, then the second of each, and so on. Labels are indices in `classes`.
    Classes without a subfolder are skipped, and so are subfolders that match none of `classes`. The name of a subfolder
    may have underscores instead of spaces. ShapeNet names its subfolders by number, but `classes` may hold the names of
    the categories. The layout within a subfolder is recognised: ModelNet, OmniObject3D, ShapeNet, or any other. If a
    class has a folder `test`, only the meshes in it are listed.

    **Raises:** `ValueError` if there is no such folder, if no class has a folder, if the folder of a class has no mesh,
    or if `classes` is not a list of names.
    """
    are_names = isinstance(classes, list | tuple) and all(isinstance(name, str) for name in classes)
    require(are_names, f"the classes are {short_text(classes)}: give a list of names")
    folder = _check_folder(folder)
    folder = folder / "raw_scans" if (folder / "raw_scans").is_dir() else folder
    paths = {_plain(path.name): path for path in sorted(folder.iterdir()) if path.is_dir()}
    rows = [(label, paths.get(_plain(name), paths.get(_SYNSETS.get(name, "")))) for label, name in enumerate(classes)]
    groups = [_class_files(path, label) for label, path in rows if path is not None]
    require(len(groups) > 0, f"the folder {folder} has none of the folders {', '.join(classes)}: give one that has")
    return tuple(interleave(groups))


def _plain(name: str) -> str:
    return name.lower().replace("_", " ")


def mesh_files(folder: str | Path) -> tuple[MeshFile, ...]:
    """List the mesh files in a folder at any depth, sorted by path, all with label 0.

    **Raises:** `ValueError` if there is no such folder, or no mesh in it.
    """
    return tuple(_class_files(_check_folder(folder), 0))


def _check_folder(folder: str | Path) -> Path:
    require(os.path.isdir(folder), f"there is no folder {folder}: give one that holds meshes")
    return Path(folder)


def _class_files(folder: Path, label: int) -> list[MeshFile]:
    formats = trimesh.available_formats()
    for pattern, up in _LAYOUTS.items():
        matches = sorted(folder.glob(pattern.format(name=folder.name)))
        files = [file for file in matches if file.suffix[1:].lower() in formats and file.is_file()]
        if files:
            # If each object has its own folder, the object is named after the folder, otherwise after the file.
            names = [file.relative_to(folder).parts[0] if pattern.startswith("*/") else file.stem for file in files]
            return [MeshFile(label, name, str(file), up) for name, file in zip(names, files, strict=True)]
    raise InputError(f"the folder {folder} holds no mesh: its files must end in {', '.join(sorted(formats))}")
