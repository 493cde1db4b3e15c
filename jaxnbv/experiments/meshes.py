"""A folder of meshes as the scenes of a study."""

from collections.abc import Sequence
from pathlib import Path

import trimesh

from jaxnbv.checks import require
from jaxnbv.scanning import TriangleMesh, load_mesh


def mesh_files(folder: str | Path) -> tuple[str, ...]:
    """The mesh files in a folder, sorted: those whose name ends as a format that trimesh reads.

    **Raises:** `ValueError` if there is no such folder, or no mesh in it.
    """
    folder = Path(folder)
    require(folder.is_dir(), f"there is no folder {folder}: give one that holds mesh files")
    formats = trimesh.available_formats()
    found = tuple(str(file) for file in sorted(folder.iterdir()) if file.suffix[1:].lower() in formats)
    require(len(found) > 0, f"the folder {folder} holds no mesh: its files must end in {', '.join(sorted(formats))}")
    return found


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
