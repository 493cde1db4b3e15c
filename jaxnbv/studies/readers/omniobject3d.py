"""OmniObject3D (Wu et al. 2023): scanned objects as meshes and as points, from a local folder."""

from collections.abc import Iterable
from pathlib import Path

import equinox as eqx
import numpy as np
import trimesh

from jaxnbv.checks import InputError, checked, require
from jaxnbv.studies.readers.labelled_points import LabelledPoints
from jaxnbv.studies.readers.local_copy import (
    as_names,
    check_file,
    checked_folder,
    chosen_folders,
    class_folders,
    present,
)
from jaxnbv.studies.readers.mesh_set import MeshFile, MeshSet

_SCAN = "Scan/Scan.obj"


class OmniObject3D(MeshSet):
    """The scans of some classes, `raw_scans/<class>/<class>_001/Scan/Scan.obj`, as they are distributed.

    The files are in millimetres, and the authors' tools take their y axis for up; here the longest side is 2.5. How an
    object lies differs from scan to scan. The numbers of the objects have gaps, and some folders no scan.
    """

    classes: tuple[str, ...] = eqx.field(static=True)
    files: tuple[MeshFile, ...] = eqx.field(static=True)

    @checked
    def __init__(self, folder: str | Path, classes: str | Iterable[str] | None = None):
        """The scans in the data set's folder, or its `raw_scans`; default classes: all that lie there. Folders of
        objects without a scan are named by a `UserWarning`.

        **Raises:** `ValueError` for a folder that is missing, or a class without a scan.
        """
        folders = _folders(scans_folder(checked_folder(folder)), classes)
        self.classes = tuple(folders)
        self.files = tuple(
            MeshFile(label, path.parents[1].name, str(path))
            for label, of_class in enumerate(folders.values())
            for path in _present(of_class, _SCAN, "scans")
        )


class OmniObject3DPoints(eqx.Module):
    """The points of the scans of some classes, each read when it is asked for: `shapes[i]`, `len(shapes)`.

    Reads `point_clouds/ply_files/1024/<class>/<class>_001/pcd_1024.ply`, as they are distributed: sampled on the scans,
    without normals, in the scans' millimetres; `normalised` brings them into the unit sphere.

    - `classes`: their names, which the labels count.
    - `files`: label of each object and its file.
    - `num_points`: of each.
    """

    classes: tuple[str, ...] = eqx.field(static=True)
    files: tuple[tuple[int, str], ...] = eqx.field(static=True)
    num_points: int = eqx.field(static=True)

    @checked
    def __init__(self, folder: str | Path, num_points: int = 1024, classes: str | Iterable[str] | None = None):
        """The points in the data set's folder; default classes: all that lie there. Folders of objects without points
        are named by a `UserWarning`.

        - `num_points`: 1024, 4096 or 16384.

        **Raises:** `ValueError` for a folder that is missing, or a class without points.
        """
        points = checked_folder(checked_folder(folder) / "point_clouds" / "ply_files" / str(num_points))
        folders = _folders(points, classes)
        self.classes, self.num_points = tuple(folders), num_points
        self.files = tuple(
            (label, str(path))
            for label, of_class in enumerate(folders.values())
            for path in _present(of_class, f"pcd_{num_points}.ply", "clouds")
        )

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, index: int) -> LabelledPoints:
        """The object at this place.

        **Raises:** `ValueError` for a file that is missing or damaged; `IndexError` beyond the end.
        """
        label, path = self.files[index]
        check_file(Path(path))
        try:
            cloud = trimesh.load(path, process=False)
        except Exception as error:  # Its readers fail in their own ways.
            raise InputError(f"cannot read {path} ({type(error).__name__}: {error}): unpack it again") from error
        points = np.array(cloud.vertices if isinstance(cloud, trimesh.PointCloud) else [], dtype=np.float64)
        require(
            points.shape == (self.num_points, 3) and bool(np.isfinite(points).all()),
            f"{path} is damaged: expected {self.num_points} points of finite coordinates; unpack it again",
        )
        return LabelledPoints(points, None, label, Path(path).parent.name)


def scans_folder(folder: Path) -> Path:
    """`raw_scans` in the data set's folder, or the folder itself where it has none."""
    return folder / "raw_scans" if (folder / "raw_scans").is_dir() else folder


def holds_scans(of_class: Path) -> bool:
    """Whether the folder of a class has scans where OmniObject3D has them."""
    return any(of_class.glob(f"*/{_SCAN}"))


def _folders(folder: Path, classes: str | Iterable[str] | None) -> dict[str, Path]:
    return chosen_folders(folder, class_folders(folder) if classes is None else as_names(classes, "class"))


def _present(of_class: Path, file: str, what: str) -> list[Path]:
    objects = [path for path in sorted(of_class.iterdir()) if path.is_dir()]
    return present([path / file for path in objects], f"{what} of {of_class}")
