"""What `jaxnbv run` sees a mesh of the user's with, and what is said of the mesh before."""

import dataclasses
import math
from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np

from jaxnbv.checks import require
from jaxnbv.cli.actions.tasks import position
from jaxnbv.cli.registry import DEFAULT_FIRST
from jaxnbv.geometry.pose import Pose, look_at
from jaxnbv.scanning import SDFSurface, Surface, TriangleMesh
from jaxnbv.scanning.sensors import Setting, fitted

_QUICK_RAYS = 24


def sensor_for(mesh: TriangleMesh, setting: Setting, asked: SimpleNamespace) -> Setting:
    """The task's camera where it sees all of the mesh; as the paper has it, or as the user asks.

    **Raises:** `ValueError` as `jaxnbv.scanning.sensors.fitted` does.
    """
    fov = None if asked.fov is None else math.radians(asked.fov)
    if asked.paper:
        camera = setting.camera if fov is None else dataclasses.replace(setting.camera, fov=fov)
        setting = setting._replace(camera=camera, radius=setting.radius if asked.radius is None else asked.radius)
    else:
        setting = fitted(setting, mesh.bounding_radius, fov, asked.radius)
    return with_rays(setting, asked.quick, asked.rays)


def with_rays(setting: Setting, quick: bool, rays: int | None = None) -> Setting:
    """The setting with so many rays along a side; by default its own, or as few as --quick has."""
    rays = rays or (_QUICK_RAYS if quick else None)
    if rays is None:
        return setting
    return setting._replace(camera=setting.camera.resized(rays, rays))


def first_pose(asked: str, surface: Surface) -> Pose:
    """Where the first view was asked for, looking at the origin.

    **Raises:** `ValueError` for what is no position, or one inside the object.
    """
    place = position("--first", asked)
    pose, inside = look_at(place), _contains(surface, np.array([place]))
    remedy = f"give a place outside, such as {DEFAULT_FIRST}"
    require(not inside, f"--first is {asked}, which is inside the object: {remedy}")
    return pose


def _contains(surface: Surface, place: np.ndarray) -> bool:
    if isinstance(surface, TriangleMesh):
        return bool(surface.contains(place)[0])
    return isinstance(surface, SDFSurface) and bool(surface.sdf(jnp.asarray(place, jnp.result_type(float)))[0] < 0)


def peculiarities(path: Path, mesh: TriangleMesh, cell: float) -> list[str]:
    """What a user should know of a mesh before it is scanned: that it is flat, or open.

    - `cell`: of the grid on which surfaces are imagined, in scene units.
    """
    found = []
    if mesh.thickness < cell:
        found.append(
            f"{path.name} is flat: it is {mesh.thickness:.2g} thick, less than a cell of the grid ({cell:.2g}) where "
            "imagined surfaces live: some will miss it"
        )
    loose, edges = mesh.open_edges
    if loose:
        found.append(
            f"{path.name} is open: {loose:,} of its {edges:,} edges belong to one face only. It is scanned from both "
            "sides; the surfaces that are imagined are closed"
        )
    return found
