"""Surface that views looked at but did not measure, because it is too dark or shiny, or does not exist."""

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
from jaxnbv.viz.answers import number_text, point_text
from jaxnbv.viz.mean_surface import padded

# Least number of views that looked at a patch (one may fail by chance), least area as a fraction of the surface, and
# largest number of patches.
_MIN_LOOKS, _MIN_AREA, _MAX_PATCHES = 2, 0.005, 3


class Patch(NamedTuple):
    """A patch of unmeasured surface: area, middle (scene units), and number of views that looked at it."""

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
    centers = jnp.asarray(padded(surface.triangles_center))
    cells = np.asarray(looks.grid.cell_of(centers))[: len(surface.faces)]
    num_looks = np.zeros((looks.grid.resolution + 1,) * 3, int)
    for index in range(count):
        is_missed = np.zeros(num_looks.shape, bool)
        cells_of_view = np.asarray(looks.unmeasured_cells(mesh, index, observations.poses.rows[index]))
        is_missed[tuple(cells_of_view[(cells_of_view < looks.grid.resolution).all(axis=1)].T)] = True
        # Include the neighbouring cells, because rays are farther apart than cells.
        num_looks += binary_dilation(is_missed, np.ones((3, 3, 3)))
    looks_of_face = num_looks[tuple(np.minimum(cells, looks.grid.resolution).T)]
    is_unmeasured = looks_of_face >= _MIN_LOOKS
    if carving is not None:
        is_unmeasured &= np.asarray(carving.volume(centers))[: len(surface.faces)] < -looks.grid.spacing
    neighbours = surface.face_adjacency[is_unmeasured[surface.face_adjacency].all(axis=1)]
    pieces = trimesh.graph.connected_components(neighbours, nodes=np.nonzero(is_unmeasured)[0])
    patches = [_patch(surface, faces, looks_of_face) for faces in pieces]
    patches = [patch for patch in patches if patch.area > _MIN_AREA * surface.area]
    return sorted(patches, key=lambda patch: -patch.area)[:_MAX_PATCHES]


def unmeasured_text(patches: Sequence[Patch], frame: Frame) -> str:
    """Return a sentence about the patches, with areas and positions in the world units of `frame`."""
    parts = [
        f"{number_text(float(frame.length_to_world(patch.area, 2)))} {frame.unit}² about "
        f"{point_text(patch.middle, frame)} ({patch.looks} looks)"
        for patch in patches
    ]
    return (
        f"Views looked at {', '.join(parts)} and measured nothing there: the surface is too dark or too shiny for the "
        "sensor, or it is not there."
    )


def _patch(surface: trimesh.Trimesh, faces: np.ndarray, looks_of_face: np.ndarray) -> Patch:
    areas = surface.area_faces[faces]
    middle = np.average(surface.triangles_center[faces], axis=0, weights=areas)
    return Patch(float(areas.sum()), middle, int(np.median(looks_of_face[faces])))
