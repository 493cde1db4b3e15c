"""Trucks and cargo from mesh files: where the bed of a truck is, and what stands on it."""

import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray

from jaxnbv.checks import InputError
from jaxnbv.scanning import TriangleMesh
from jaxnbv.studies.scenes.class_object import ClassMesh
from jaxnbv.studies.scenes.labelled import generator, rotation_about
from jaxnbv.studies.scenes.truck import random_rotation, stowed

# The truck is looked at from above, along so many lines of rays.
_LINES = 96
# Shares of a truck's height: where a bed's floor can be, how even it is, and the room that must be above it.
_LOWEST, _HIGHEST, _EVEN = 0.15, 0.85, 0.02


def bed_of(truck: TriangleMesh) -> Float[np.ndarray, "2 3"]:
    """The lowest and the highest corner of the room above an upright truck's bed, in its scene coordinates.

    The floor is the largest level rectangle along the axes that shows from above, neither at the truck's top nor at
    its bottom; the room reaches to the truck's top.

    **Raises:** `ValueError` if none is as large as a tenth of the truck's outline.
    """
    low, high = truck.vertices.min(axis=0), truck.vertices.max(axis=0)
    across = [np.linspace(low[axis], high[axis], 2 * _LINES + 1)[1::2] for axis in (0, 2)]
    x, z = np.meshgrid(*across, indexing="ij")
    above = np.stack([x, np.full_like(x, high[1] + 1.0), z], axis=-1).reshape(-1, 3)
    hits = truck.trace(above, np.tile([0.0, -1.0, 0.0], (len(above), 1)))
    heights = np.where(hits.mask, np.asarray(hits.points)[:, 1], -np.inf).reshape(_LINES, _LINES)
    tall = high[1] - low[1]
    best, floor, area = None, 0.0, 0
    for level in np.arange(low[1] + _LOWEST * tall, low[1] + _HIGHEST * tall, 0.5 * _EVEN * tall):
        found = _largest_rectangle(np.abs(heights - level) <= 0.5 * _EVEN * tall)
        size = (found[1] - found[0]) * (found[3] - found[2])
        if size > area:
            best, area = found, size
            floor = float(heights[found[0] : found[1], found[2] : found[3]].max())
    if best is None or area < 0.1 * _LINES**2:
        raise InputError(
            f"the largest level place of the truck covers {area / _LINES**2:.0%} of its outline: give one that stands "
            "upright and has an open bed"
        )
    half = 0.5 * (high - low) / _LINES
    first = [across[0][best[0]] - half[0], floor, across[1][best[2]] - half[2]]
    last = [across[0][best[1] - 1] + half[0], high[1], across[1][best[3] - 1] + half[2]]
    return np.array([first, last])


def _largest_rectangle(flags: Bool[np.ndarray, "m n"]) -> tuple[int, int, int, int]:
    """The first and the end of the rows and of the columns of the largest rectangle of true entries."""
    best, area = (0, 0, 0, 0), 0
    for top in range(len(flags)):
        whole = np.ones(flags.shape[1], bool)
        for bottom in range(top, len(flags)):
            whole &= flags[bottom]
            edges = np.flatnonzero(np.diff(np.concatenate([[0], whole.astype(np.int8), [0]])))
            if len(edges) == 0:
                break
            lengths = edges[1::2] - edges[::2]
            widest = int(np.argmax(lengths))
            if (bottom + 1 - top) * lengths[widest] > area:
                area = int((bottom + 1 - top) * lengths[widest])
                best = (top, bottom + 1, int(edges[2 * widest]), int(edges[2 * widest + 1]))
    return best


def loaded_truck(truck: TriangleMesh, cargo: TriangleMesh, label: int, key: PRNGKeyArray) -> ClassMesh:
    """A truck that carries an object of a class, both upright as they are given, as `truck_scene` places them: the
    cargo is turned at random about the vertical, as large as the bed has room for, and the loaded truck in any
    direction.

    **Raises:** `ValueError` as `bed_of` does.
    """
    rng = generator(key)
    turned = cargo.vertices @ rotation_about((0.0, 1.0, 0.0), rng.uniform(-np.pi, np.pi)).T
    scale, offset = stowed(bed_of(truck), np.stack([turned.min(axis=0), turned.max(axis=0)]), rng)
    placed = scale * turned + offset
    rotation = random_rotation(rng)
    vertices = np.concatenate([truck.vertices, placed]) @ rotation.T
    whole = TriangleMesh.from_arrays(vertices, np.concatenate([truck.faces, cargo.faces + len(truck.vertices)]))
    part = TriangleMesh(whole.frame.to_scene(placed @ rotation.T), cargo.faces, whole.frame)
    return ClassMesh(whole, label, part)
