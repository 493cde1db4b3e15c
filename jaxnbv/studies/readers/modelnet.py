"""ModelNet10 and ModelNet40 (Wu et al. 2015): meshes of household objects and others, from a local folder."""

from collections.abc import Iterable
from pathlib import Path

import equinox as eqx

from jaxnbv.checks import checked, require
from jaxnbv.studies.readers.local_copy import (
    as_names,
    checked_folder,
    chosen_folders,
    class_folders,
    class_name,
    present,
)
from jaxnbv.studies.readers.mesh_set import MeshFile, MeshSet

# How many meshes of a class are for training and for tests; the data set numbers them from 1, those for training first.
_COUNTS = {
    "airplane": (626, 100),
    "bathtub": (106, 50),
    "bed": (515, 100),
    "bench": (173, 20),
    "bookshelf": (572, 100),
    "bottle": (335, 100),
    "bowl": (64, 20),
    "car": (197, 100),
    "chair": (889, 100),
    "cone": (167, 20),
    "cup": (79, 20),
    "curtain": (138, 20),
    "desk": (200, 86),
    "door": (109, 20),
    "dresser": (200, 86),
    "flower pot": (149, 20),
    "glass box": (171, 100),
    "guitar": (155, 100),
    "keyboard": (145, 20),
    "lamp": (124, 20),
    "laptop": (149, 20),
    "mantel": (284, 100),
    "monitor": (465, 100),
    "night stand": (200, 86),
    "person": (88, 20),
    "piano": (231, 100),
    "plant": (240, 100),
    "radio": (104, 20),
    "range hood": (115, 100),
    "sink": (128, 20),
    "sofa": (680, 100),
    "stairs": (124, 20),
    "stool": (90, 20),
    "table": (392, 100),
    "tent": (163, 20),
    "toilet": (344, 100),
    "tv stand": (267, 100),
    "vase": (475, 100),
    "wardrobe": (87, 20),
    "xbox": (103, 20),
}
MODELNET40 = tuple(_COUNTS)
MODELNET10 = ("bathtub", "bed", "chair", "desk", "dresser", "monitor", "night stand", "sofa", "table", "toilet")
_SPLITS = ("train", "test")


class ModelNet(MeshSet):
    """The meshes of a split of ModelNet10 or ModelNet40, `<class>/<split>/<class>_0001.off`, as they are distributed.

    In the files the z axis points up, and each object has units of its own; here y does, as in the resampled points
    that the published networks are trained on, and the longest side is 2.5. Objects of a class face the same way in
    ModelNet10, not in ModelNet40.
    """

    classes: tuple[str, ...] = eqx.field(static=True)
    files: tuple[MeshFile, ...] = eqx.field(static=True)

    @checked
    def __init__(self, folder: str | Path, split: str, classes: str | Iterable[str] | None = None):
        """The meshes of the split "train" or "test"; default classes: all ten of ModelNet10, or all forty where the
        folder has others than these. Meshes that the data set has and the folder has not are named by a `UserWarning`.

        **Raises:** `ValueError` for an unknown split or class, a folder that is missing, or a class without a mesh.
        """
        folder = checked_folder(folder)
        check_split(split)
        if classes is None:
            known = MODELNET40 if {*class_folders(folder)} & ({*MODELNET40} - {*MODELNET10}) else MODELNET10
        else:
            known = tuple(map(class_name, as_names(classes, "class")))
        unknown = [name for name in known if name not in _COUNTS]
        require(not unknown, f"there is no class {unknown} in ModelNet: choose from {', '.join(MODELNET40)}")
        folders = chosen_folders(folder, known)
        self.classes = tuple(folders)
        self.files = tuple(
            MeshFile(label, file.stem, str(file), up="z")
            for label, (name, of_class) in enumerate(folders.items())
            for file in present(_expected(of_class, name, split), f"meshes of {of_class / split}")
        )


def check_split(split: str) -> None:
    """**Raises:** `ValueError` for what is no split of ModelNet."""
    require(split in _SPLITS, f"there is no split '{split}': choose from {', '.join(_SPLITS)}")


def is_modelnet(of_class: Path) -> bool:
    """Whether the folder of a class has meshes for tests that are named as ModelNet names them."""
    name = class_name(of_class.name)
    return name in _COUNTS and any(file.is_file() for file in _expected(of_class, name, "test"))


def _expected(of_class: Path, name: str, split: str) -> list[Path]:
    training, testing = _COUNTS[name]
    numbers = range(1, training + 1) if split == "train" else range(training + 1, training + testing + 1)
    return [of_class / split / f"{name.replace(' ', '_')}_{number:04d}.off" for number in numbers]
