"""Surface that views looked at but did not measure, because it is too dark or too shiny, or does not exist."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Float
from scipy.ndimage import binary_dilation

from jaxnbv.geometry.frame import Frame
from jaxnbv.observations import Observations
from jaxnbv.scanning import Carving, TriangleMesh
from jaxnbv.viz.answers import coordinates, number

# Least number of views that looked at a patch, since one may be chance. Least fraction of the surface in a patch.
# Maximum number of patches.
_LOOKS, _SHARE, _PATCHES = 2, 0.005, 3


class Patch(NamedTuple):
    """A piece of unmeasured surface: area and middle in scene units, and number of views that faced it."""

    area: float
    middle: Float[np.ndarray, "3"]
    looks: int


def unmeasured(surface: trimesh.Trimesh, observations: Observations, carving: Carving | None) -> list[Patch]:
    """Return patches of a surface that at least two views looked at but did not measure.

    At most three are returned, the largest first. Planes where the carving volume cuts the surface do not count.

    - `surface`: an estimate from the observations, such as the posterior's mean, in scene coordinates.
    """
    looks = observations.looks
    if looks is None or len(surface.faces) == 0:
        return []
    mesh, count = TriangleMesh(surface.vertices, surface.faces, Frame()), int(observations.num_views)
    cells = np.asarray(looks.grid.cell_of(jnp.asarray(surface.triangles_center)))
    times = np.zeros((looks.grid.resolution + 1,) * 3, int)
    for index in range(count):
        in_vain = np.zeros(times.shape, bool)
        cells_of_view = np.asarray(looks.unmeasured_cells(mesh, index, observations.poses.rows[index]))
        in_vain[tuple(cells_of_view[(cells_of_view < looks.grid.resolution).all(axis=1)].T)] = True
        # Include the neighbouring cells, because rays are farther apart than cells.
        times += binary_dilation(in_vain, np.ones((3, 3, 3)))
    of_face = times[tuple(np.minimum(cells, looks.grid.resolution).T)]
    chosen = of_face >= _LOOKS
    if carving is not None:
        chosen &= np.asarray(carving.volume(jnp.asarray(surface.triangles_center))) < -looks.grid.spacing
    pieces = trimesh.graph.connected_components(
        surface.face_adjacency[chosen[surface.face_adjacency].all(axis=1)], nodes=np.nonzero(chosen)[0]
    )
    patches = [_patch(surface, faces, of_face) for faces in pieces]
    patches = [patch for patch in patches if patch.area > _SHARE * surface.area]
    return sorted(patches, key=lambda patch: -patch.area)[:_PATCHES]


def unmeasured_words(patches: Sequence[Patch], frame: Frame) -> str:
    """Return a sentence about the patches, with areas and positions in the world of a frame."""
    parts = [
        f"{number(float(frame.length_to_world(patch.area, 2)))} {frame.unit}² about {coordinates(patch.middle, frame)} "
        f"({patch.looks} looks)"
        for patch in patches
    ]
    return (
        f"Views looked at {', '.join(parts)} and measured nothing there: the surface is too dark or too shiny for the "
        "sensor, or it is not there."
    )


def _patch(surface: trimesh.Trimesh, faces: np.ndarray, times: np.ndarray) -> Patch:
    areas = surface.area_faces[faces]
    middle = np.average(surface.triangles_center[faces], axis=0, weights=areas)
    return Patch(float(areas.sum()), middle, int(np.median(times[faces])))
