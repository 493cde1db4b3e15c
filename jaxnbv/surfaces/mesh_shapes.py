"""Meshes as shapes of a bank: signed distances on grids, cached in the user's cache folder."""

import hashlib
import os
import secrets
import warnings
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax.numpy as jnp
import numpy as np
import platformdirs
import trimesh
from jaxtyping import Float

from jaxnbv.checks import InputError, check_type, require, short_text
from jaxnbv.geometry.pose import fibonacci_sphere
from jaxnbv.progress import progress_bar
from jaxnbv.scanning.mesh import TriangleMesh
from jaxnbv.scanning.mesh_files import load_mesh
from jaxnbv.scanning.sdf import Sampled, solid_of_mesh

# Increase this number when the code that computes the cached arrays changes.
_VERSION = 3
_ARRAYS = ("values", "low", "spacing", "padding", "extremes", "from_mesh")
_T = TypeVar("_T")


def as_tuple(values: Sequence[_T], name: str) -> tuple[_T, ...]:
    """Return the values, called `name` in errors, as a tuple. **Raises:** `ValueError` if not iterable."""
    try:
        return tuple(values)
    except TypeError as error:
        raise InputError(f"{name} are {short_text(values)}; give a list") from error


def mesh_paths(meshes: str | Path | Sequence[str | Path | trimesh.Trimesh]) -> list[Path | trimesh.Trimesh]:
    """Return the listed files and meshes, or all mesh files in a folder and its subfolders.

    A mesh file has the extension of a format that trimesh reads.

    **Raises:** `ValueError` for a folder that does not exist or contains no mesh, or for an empty list.
    """
    if isinstance(meshes, str | Path):
        folder = Path(meshes)
        require(os.path.isdir(folder), f"there is no folder {folder}: give one that holds meshes, or a list of files")
        formats = trimesh.available_formats()
        meshes = [path for path in sorted(folder.rglob("*")) if path.suffix[1:].lower() in formats and path.is_file()]
        extensions = ", ".join(sorted(formats))
        require(len(meshes) > 0, f"the folder {folder} holds no mesh: its files must end in {extensions}")
    items = as_tuple(meshes, "the meshes")
    require(len(items) > 0, "no meshes are named: give their files, or a folder")
    for path in items:
        check_type(path, str | Path | trimesh.Trimesh, "a mesh")
    return [path if isinstance(path, trimesh.Trimesh) else Path(path) for path in items]


class MeshShape(NamedTuple):
    """A mesh as a shape of a bank, scaled so that its longest side is 2.5.

    - `extremes`: the farthest vertex in each of several evenly spread directions.
    - `from_mesh`: the similarity transform from coordinates of the mesh to coordinates of the shape.
    """

    solid: Sampled
    extremes: Float[np.ndarray, "p 3"]
    from_mesh: Float[np.ndarray, "4 4"]


def shapes_of_meshes(
    paths: Sequence[Path | trimesh.Trimesh], resolution: int, sheet: float, num_extremes: int, up: str, progress: bool
) -> tuple[list[MeshShape], list[int]]:
    """Return the shapes of all usable meshes, and the indices of these meshes. Warn of each unusable mesh.

    See `ShapeBank.from_meshes` for the arguments.

    **Raises:** `ValueError` if no mesh can be used.
    """
    shapes, rows = [], []
    for index, path in enumerate(progress_bar(paths, progress, desc="meshes read")):
        try:
            shape = _shape(path, resolution, sheet, num_extremes, up)
        except InputError as error:
            warnings.warn(f"{path} is left out of the bank: {error}", stacklevel=3)
            continue
        shapes.append(shape)
        rows.append(index)
    require(len(rows) > 0, f"none of the {len(paths)} meshes can be used, the first of them {paths[0]}")
    return shapes, rows


def _shape(mesh: Path | trimesh.Trimesh, resolution: int, sheet: float, num_extremes: int, up: str) -> MeshShape:
    settings = resolution, sheet, num_extremes
    arrays = _load_cached(mesh, *settings, up) if isinstance(mesh, Path) else _sample(load_mesh(mesh, up), *settings)
    solid = Sampled(*(jnp.asarray(arrays[name]) for name in ("values", "low", "spacing", "padding")))
    return MeshShape(solid, arrays["extremes"], arrays["from_mesh"])


def _load_cached(path: Path, resolution: int, sheet: float, num_extremes: int, up: str) -> dict[str, np.ndarray]:
    require(os.path.isfile(path), f"cannot read {path}: there is no file")
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path} ({error.strerror or error})") from error
    settings = f"{_VERSION} {path.suffix} {resolution} {sheet} {num_extremes} {up} ".encode()
    file = platformdirs.user_cache_path("jaxnbv") / "shapes" / f"{hashlib.sha256(settings + content).hexdigest()}.npz"
    arrays = _read(file)
    if arrays is None:
        arrays = _sample(load_mesh(path, up), resolution, sheet, num_extremes)
        _write(file, arrays)
    return arrays


def _sample(mesh: TriangleMesh, resolution: int, sheet: float, num_extremes: int) -> dict[str, np.ndarray]:
    solid = solid_of_mesh(mesh.vertices, mesh.faces, resolution, sheet, cubic=True)
    require(
        bool((np.asarray(solid.values) < 0).any()), "it is thinner than the grid: raise the resolution or the sheet"
    )
    directions = np.asarray(fibonacci_sphere(num_extremes))
    extremes = mesh.vertices[np.argmax(mesh.vertices @ directions.T, axis=0)]
    from_mesh = np.eye(4)
    from_mesh[:3, :3] = mesh.frame.scale * mesh.frame.rotation
    from_mesh[:3, 3] = -from_mesh[:3, :3] @ mesh.frame.center
    arrays: dict[str, Any] = {name: getattr(solid, name) for name in _ARRAYS[:4]}
    arrays |= {"extremes": extremes, "from_mesh": from_mesh}
    return {name: np.asarray(array, np.float32) for name, array in arrays.items()}


def _read(file: Path) -> dict[str, np.ndarray] | None:
    """Return the cached arrays, or None if the file is missing or damaged."""
    try:
        with np.load(file) as archive:
            return {name: archive[name] for name in _ARRAYS}
    except (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile, zlib.error):
        return None


def _write(file: Path, arrays: dict[str, Any]) -> None:
    """Write arrays to the cache, or warn if writing fails, for example on a full disk."""
    partial = file.with_suffix(f".{secrets.token_hex(8)}.npz")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(partial, **arrays)
        partial.replace(file)
    except OSError as error:
        partial.unlink(missing_ok=True)
        warnings.warn(f"the shape cannot be stored in the cache ({error.strerror or error})", stacklevel=2)
