"""ShapeNet-part (Yi et al. 2016): shapes as oriented points, each with the label of its part, from a local folder."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from jaxnbv.checks import InputError, checked, require
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.frame import Frame
from jaxnbv.networks.categories import CATEGORIES, category_index
from jaxnbv.studies.readers.labelled_points import unit_sphere
from jaxnbv.studies.readers.local_copy import as_names, check_listed, checked_folder, read_rows, read_text

_SPLITS = {"train": "train", "validation": "val", "test": "test"}
_CATEGORY_FILE = "synsetoffset2category.txt"
_COLUMNS = "x y z nx ny nz label"


class LabelledShape(NamedTuple):
    """The points of one object, in the units of its file, and what they belong to.

    - `points`, `normals`: as in the file; the y axis points up.
    - `labels`: of the parts, among the fifty of all categories.
    - `category`: its index in `shapenet.CATEGORIES`.
    - `name`: the object's identifier.
    """

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    labels: Int[np.ndarray, " n"]
    category: int
    name: str

    def normalised(self) -> "LabelledShape":
        """The shape as the published networks expect it: in the unit sphere about its centre."""
        return self._replace(points=unit_sphere(self.points))

    def to_cloud(self, frame: Frame) -> PointCloud:
        """The points as a cloud in scene coordinates; row for row, so the labels stay true.

        **Raises:** `ValueError` as `PointCloud.from_arrays` does.
        """
        return frame.to_scene(PointCloud.from_arrays(self.points, self.normals))


class ShapeNetPart(eqx.Module):
    """The shapes of a split, each read when it is asked for: `shapes[i]`, `len(shapes)`, `for shape in shapes`.

    Reads the folder `shapenetcore_partanno_segmentation_benchmark_v0_normal`, as its authors distribute it.

    - `folder`: where it lies.
    - `entries`: category of each shape and its file in the folder, in the order of the split's list.
    """

    folder: Path = eqx.field(static=True)
    entries: tuple[tuple[int, str], ...] = eqx.field(static=True)

    @checked
    def __init__(self, folder: str | Path, split: str, categories: str | Iterable[str] | None = None):
        """The shapes of the split "train", "validation" or "test" that belong to the categories; default: to any.

        **Raises:** `ValueError` for a folder, a list or a table of categories that is missing or damaged, an unknown
        split or category, no shape at all, and shapes that the list names and the folder has not: how many, and the
        first.
        """
        self.folder = checked_folder(folder)
        require(split in _SPLITS, f"there is no split '{split}': choose from {', '.join(_SPLITS)}")
        synsets = _read_synsets(self.folder / _CATEGORY_FILE)
        chosen = None if categories is None else as_names(categories, "category")
        wanted = set(synsets.values()) if chosen is None else {category_index(name) for name in chosen}
        absent = [CATEGORIES[index].name for index in sorted(wanted - set(synsets.values()))]
        require(not absent, f"{self.folder / _CATEGORY_FILE} does not list {absent}: choose other categories")
        path = self.folder / "train_test_split" / f"shuffled_{_SPLITS[split]}_file_list.json"
        self.entries = tuple(entry for entry in _read_list(path, synsets) if entry[0] in wanted)
        require(len(self.entries) > 0, f"{path} lists no shape of these categories: choose others")
        check_listed([self.folder / file for _, file in self.entries], path)

    def __len__(self) -> int:
        return len(self.entries)

    def __getitem__(self, index: int) -> LabelledShape:
        """The shape at this place of the list.

        **Raises:** `ValueError` for a file that is missing, damaged, or has a label of another category; `IndexError`
        beyond the list's end.
        """
        category, file = self.entries[index]
        return _read_shape(self.folder / file, category)


def _read_synsets(path: Path) -> dict[str, int]:
    """The category that each folder holds."""
    synsets = {}
    for line in read_text(path).splitlines():
        if not line.strip():
            continue
        words = line.split()
        require(len(words) == 2, f"{path} has the line '{line}'; expected a category and its folder")
        synsets[words[1]] = category_index(words[0])
    require(len(synsets) > 0, f"{path} lists no category: unpack the data set again")
    return synsets


def _read_list(path: Path, synsets: dict[str, int]) -> list[tuple[int, str]]:
    """Category and file of each shape, of lines such as "shape_data/02691156/<identifier>"."""
    try:
        lines = json.loads(read_text(path))
    except json.JSONDecodeError as error:
        raise InputError(f"{path} is damaged ({error}): unpack the data set again") from error
    require(isinstance(lines, list), f"{path} holds no list: unpack the data set again")
    entries = []
    for line in lines:
        parts = line.split("/") if isinstance(line, str) else []
        require(
            len(parts) == 3 and parts[1] in synsets and len(parts[2]) > 0,
            f"{path} lists {line!r}; expected shape_data/<folder>/<identifier> with a folder of {_CATEGORY_FILE}",
        )
        entries.append((synsets[parts[1]], f"{parts[1]}/{parts[2]}.txt"))
    return entries


def _read_shape(path: Path, category: int) -> LabelledShape:
    rows = read_rows(path, _COLUMNS)
    known = CATEGORIES[category]
    bad = np.flatnonzero(~np.isin(rows[:, 6], known.labels))
    require(
        bad.size == 0,
        f"{path} has the label {rows[bad[:1], 6]} in row {bad[:1]}; the parts of the category {known.name} are "
        f"{known.labels[0]} to {known.labels[-1]}",
    )
    return LabelledShape(rows[:, :3], rows[:, 3:6], rows[:, 6].astype(np.int64), category, path.stem)
