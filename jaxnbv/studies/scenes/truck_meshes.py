"""Functions that find the bed of a truck mesh and place a cargo mesh on it."""

import operator
from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray

from jaxnbv.checks import require
from jaxnbv.scanning import TriangleMesh
from jaxnbv.studies.scenes.class_object import ClassMesh
from jaxnbv.studies.scenes.labelled import generator, rotation_about
from jaxnbv.studies.scenes.truck import placement_on_bed, random_rotation

# Number of rows, and of columns, in the grid of rays that are traced down onto the truck.
_NUM_LINES = 96
# Fractions of a truck's height: lowest and highest floor of a bed, and largest range of heights within one floor.
_MIN_FLOOR, _MAX_FLOOR, _MAX_UNEVENNESS = 0.15, 0.85, 0.02


def bed_of(truck: TriangleMesh) -> Float[np.ndarray, "2 3"]:
    """Return the lowest and highest corner of the space above a truck's bed, in scene coordinates.

    The truck must be upright. The floor of the bed is the largest level, axis-aligned rectangle between 15 and 85 % of
    the truck's height that is visible from above. The space above the bed ends at the height of the truck's top.

    **Raises:** `ValueError` if no such rectangle covers 10 % of the truck's bounding rectangle as seen from above.
    """
    low, high = truck.vertices.min(axis=0), truck.vertices.max(axis=0)
    coordinates = [np.linspace(low[axis], high[axis], 2 * _NUM_LINES + 1)[1::2] for axis in (0, 2)]
    x, z = np.meshgrid(*coordinates, indexing="ij")
    origins = np.stack([x, np.full_like(x, high[1] + 1.0), z], axis=-1).reshape(-1, 3)
    hits = truck.trace(origins, np.tile([0.0, -1.0, 0.0], (len(origins), 1)))
    heights = np.where(hits.mask, np.asarray(hits.points)[:, 1], -np.inf).reshape(_NUM_LINES, _NUM_LINES)
    truck_height = high[1] - low[1]
    step = 0.5 * _MAX_UNEVENNESS * truck_height
    levels = np.arange(low[1] + _MIN_FLOOR * truck_height, low[1] + _MAX_FLOOR * truck_height, step)
    rectangles = (each for level in levels for each in _rectangles(np.abs(heights - level) <= step))
    area, rows, columns = max(rectangles, key=operator.itemgetter(0), default=(0, slice(0), slice(0)))
    require(
        area >= 0.1 * _NUM_LINES**2,
        f"the largest level area of the truck covers {area / _NUM_LINES**2:.0%} of its outline: give a truck that "
        "stands upright and has an open bed",
    )
    half, x, z = 0.5 * (high - low) / _NUM_LINES, coordinates[0][rows], coordinates[1][columns]
    floor = float(heights[rows, columns].max())
    return np.array([[x[0] - half[0], floor, z[0] - half[2]], [x[-1] + half[0], high[1], z[-1] + half[2]]])


def _rectangles(flags: Bool[np.ndarray, "m n"]) -> Iterator[tuple[int, slice, slice]]:
    """Yield area, rows and columns of the widest all-True rectangle for each pair of first and last row."""
    for top in range(len(flags)):
        is_whole = np.ones(flags.shape[1], bool)
        for bottom in range(top, len(flags)):
            is_whole &= flags[bottom]
            edges = np.flatnonzero(np.diff(np.concatenate([[0], is_whole.astype(np.int8), [0]])))
            if len(edges) == 0:
                break
            widths = edges[1::2] - edges[::2]
            widest = int(np.argmax(widths))
            columns = slice(edges[2 * widest], edges[2 * widest + 1])
            yield int((bottom + 1 - top) * widths[widest]), slice(top, bottom + 1), columns


def loaded_truck(truck: TriangleMesh, cargo: TriangleMesh, label: int, key: PRNGKeyArray) -> ClassMesh:
    """Return a truck mesh that carries a cargo mesh of a class (`label`), placed as in `truck_scene`.

    Both meshes must be upright. The cargo is rotated about the vertical by a random angle and scaled to fill the bed.
    The loaded truck has a random rotation.

    **Raises:** `ValueError` if the truck has no bed that `bed_of` finds.
    """
    rng = generator(key)
    rotated_vertices = cargo.vertices @ rotation_about((0.0, 1.0, 0.0), rng.uniform(-np.pi, np.pi)).T
    bounds = np.stack([rotated_vertices.min(axis=0), rotated_vertices.max(axis=0)])
    scale, offset = placement_on_bed(bed_of(truck), bounds, rng)
    cargo_vertices = scale * rotated_vertices + offset
    rotation = random_rotation(rng)
    vertices = np.concatenate([truck.vertices, cargo_vertices]) @ rotation.T
    mesh = TriangleMesh.from_arrays(vertices, np.concatenate([truck.faces, cargo.faces + len(truck.vertices)]))
    cue = TriangleMesh(mesh.frame.to_scene(cargo_vertices @ rotation.T), cargo.faces, mesh.frame)
    return ClassMesh(mesh, label, cue)
