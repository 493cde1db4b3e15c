"""ModelNet resampled (Qi et al. 2017, PointNet++): 10,000 oriented points of each mesh, from a local folder."""

from pathlib import Path

import equinox as eqx
import numpy as np

from jaxnbv.checks import checked, require
from jaxnbv.studies.readers.labelled_points import LabelledPoints
from jaxnbv.studies.readers.local_copy import check_listed, checked_folder, class_name, read_lines, read_rows
from jaxnbv.studies.readers.modelnet import check_split

_COLUMNS = "x,y,z,nx,ny,nz"


class ModelNetPoints(eqx.Module):
    """The objects of a split, each read when it is asked for: `shapes[i]`, `len(shapes)`, `for shape in shapes`.

    Reads the folder `modelnet40_normal_resampled`, as its authors distribute it. The y axis points up, and the points
    lie in the unit sphere; `normalised` moves their mean to its centre.

    - `folder`: where it lies.
    - `classes`: their names, in the order of `modelnet40_shape_names.txt`, which is that of the published networks.
    - `entries`: label of each object and its file in the folder, in the order of the split's list.
    """

    folder: Path = eqx.field(static=True)
    classes: tuple[str, ...] = eqx.field(static=True)
    entries: tuple[tuple[int, str], ...] = eqx.field(static=True)

    @checked
    def __init__(self, folder: str | Path, split: str, num_classes: int = 40):
        """The objects of the split "train" or "test" of ModelNet40, or of ModelNet10.

        **Raises:** `ValueError` for an unknown split or number of classes; a folder or list that is missing or damaged;
        and objects that the list names and the folder has not: how many, and the first.
        """
        self.folder = checked_folder(folder)
        check_split(split)
        require(num_classes in (10, 40), f"there is no ModelNet of {num_classes} classes: give 10 or 40")
        names_file = f"modelnet{num_classes}_shape_names.txt"
        names = read_lines(self.folder / names_file)
        self.classes = tuple(class_name(name) for name in names)
        path = self.folder / f"modelnet{num_classes}_{split}.txt"
        entries = []
        for line in read_lines(path):
            name, _, number = line.rpartition("_")
            require(
                name in names and number.isdigit(),
                f"{path} lists '{line}'; expected <class>_<number> with a class of {names_file}",
            )
            entries.append((names.index(name), f"{name}/{line}.txt"))
        self.entries = tuple(entries)
        check_listed([self.folder / file for _, file in self.entries], path)

    def __len__(self) -> int:
        return len(self.entries)

    def __getitem__(self, index: int) -> LabelledPoints:
        """The object at this place of the list.

        **Raises:** `ValueError` for a file that is missing or damaged, or has a normal of length zero; `IndexError`
        beyond the list's end.
        """
        label, file = self.entries[index]
        path = self.folder / file
        rows = read_rows(path, _COLUMNS, ",")
        zero = np.flatnonzero(~rows[:, 3:].any(axis=1))
        require(
            zero.size == 0,
            f"{path} has {zero.size} normals of length zero, the first in row {zero[:1]}: unpack it again",
        )
        return LabelledPoints(rows[:, :3], rows[:, 3:], label, path.stem)
