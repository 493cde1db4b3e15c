"""The meshes of a data set, each read when it is asked for."""

from pathlib import Path
from typing import NamedTuple

import equinox as eqx

from jaxnbv.scanning import TriangleMesh, load_mesh
from jaxnbv.studies.readers.local_copy import check_file


class LabelledMesh(NamedTuple):
    """A mesh in scene coordinates, upright and with a longest side of 2.5.

    - `mesh`: what is scanned; `mesh.frame` leads back to the units of its file.
    - `label`: the place of its class in the data set's `classes`.
    - `name`: the object's.
    """

    mesh: TriangleMesh
    label: int
    name: str


class MeshFile(NamedTuple):
    """Where a mesh lies, and what is known of it without reading it.

    - `label`, `name`: as of a `LabelledMesh`.
    - `path`: of the file.
    - `up`: the file's axis that is upward, see `Frame`.
    """

    label: int
    name: str
    path: str
    up: str = "y"

    def read(self) -> TriangleMesh:
        """The mesh, see `load_mesh`.

        **Raises:** `ValueError` if the file is missing or damaged.
        """
        check_file(Path(self.path))
        return load_mesh(self.path, self.up)


class MeshSet(eqx.Module):
    """Meshes of several classes: `meshes[i]`, `len(meshes)`, `for mesh in meshes`.

    - `classes`: their names, which the labels count.
    - `files`: one for each mesh, by class.
    """

    classes: eqx.AbstractVar[tuple[str, ...]]
    files: eqx.AbstractVar[tuple[MeshFile, ...]]

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, index: int) -> LabelledMesh:
        """The mesh at this place.

        **Raises:** `ValueError` for a file that is missing or damaged; `IndexError` beyond the end.
        """
        file = self.files[index]
        return LabelledMesh(file.read(), file.label, file.name)
