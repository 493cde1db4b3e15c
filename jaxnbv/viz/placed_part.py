"""The known parts that the object may be, as triangles where they lie."""

import jax.numpy as jnp
import numpy as np

from jaxnbv.geometry.tensor_grid import on_tensor_grid
from jaxnbv.scanning import Grid
from jaxnbv.scanning.mesh import level_triangles
from jaxnbv.surfaces.part_hypotheses import NONE, PartHypotheses
from jaxnbv.viz.mean_surface import MeanSurface

_NODES, _ROOM = 128, 1.05


class PlacedPart(MeanSurface):
    """A part of a bank where it lies, in scene coordinates, and how likely it is; its deviation is zero."""

    name: str
    probability: float

    @property
    def caption(self) -> str:
        """Its name and probability."""
        return f"{self.name}  {100 * self.probability:.0f} %"


def placed_parts(hypotheses: PartHypotheses, count: int) -> list[PlacedPart]:
    """The likeliest parts, each in the likeliest of its placements."""
    shapes, weights = np.asarray(hypotheses.placed.shape), np.asarray(hypotheses.shape_weights)
    return [
        _placed(hypotheses, int(np.argmax(shapes == part)), float(weights[part]))
        for part in np.argsort(-weights)[:count]
        if weights[part] > 0
    ]


def likeliest_part(hypotheses: PartHypotheses) -> PlacedPart | None:
    """The likeliest part; None where the object is more likely none of the bank's."""
    return None if next(iter(hypotheses.names())) == NONE else placed_parts(hypotheses, 1)[0]


def _placed(hypotheses: PartHypotheses, row: int, probability: float) -> PlacedPart:
    placed, bank = hypotheses.placed, hypotheses.bank
    shape = bank.shape(placed.shape[row])
    grid = Grid(_NODES, _ROOM * float(jnp.max(jnp.abs(shape.extremes))))
    triangles = level_triangles(np.array(on_tensor_grid(shape.solid, jnp.asarray(grid.axis, jnp.float32))), grid)
    assert triangles is not None
    vertices, faces, normals = triangles
    place = placed.placement
    rotation, shift = np.asarray(place.rotation[row], np.float64), np.asarray(place.shift[row], np.float64)
    name = bank.names[int(placed.shape[row])]
    return PlacedPart(
        vertices @ rotation.T + shift, faces, normals @ rotation.T, np.zeros(len(vertices)), name, probability
    )
