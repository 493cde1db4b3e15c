"""The likeliest known shape at its placement, and where the other hypotheses differ from it."""

import dataclasses
from typing import NamedTuple, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Array, Float
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from jaxnbv.checks import AnyArray
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.tensor_grid import on_tensor_grid
from jaxnbv.programs import program
from jaxnbv.scanning import Grid
from jaxnbv.scanning.mesh import level_triangles
from jaxnbv.scanning.sdf import SignedDistance
from jaxnbv.surfaces.known_shapes import kind_of
from jaxnbv.surfaces.part_hypotheses import NONE, PartHypotheses
from jaxnbv.surfaces.registration import Hypotheses
from jaxnbv.surfaces.shape_bank import ShapeBank
from jaxnbv.utility import Answer
from jaxnbv.viz.mean_surface import MeanSurface
from jaxnbv.viz.sphere import unit

T = TypeVar("T")
_Values: TypeAlias = Float[np.ndarray, "_ _ _"]

# Nodes along each axis of the grids for the surface of a shape, for its disputed space, and for the distances to the
# hypotheses. Half extent of the grids relative to the half extent of the shapes.
_NODES, _FINE_NODES, _COARSE_NODES, _MARGIN = 128, 96, 48, 1.05
# No shape is drawn if the probability of "none of these" exceeds this. It is high, because few objects fit a shape of a
# bank exactly.
_MAX_NONE_PROBABILITY = 0.9
# Largest number of hypotheses to compare. Space outside the shape is disputed if hypotheses that fill it have at least
# this fraction of the probability.
_MAX_HYPOTHESES, _MIN_DISPUTED = 12, 0.1
# Surfaces of two hypotheses agree up to about twice this distance. Softness of the step from inside to outside. Both in
# scene units.
_TOLERANCE, _SOFTNESS = 0.05, 0.012
# Pieces of disputed space smaller than this fraction of the shape's area are left out.
_MIN_PIECE = 0.01
# Surface this near to a scanned point counts as measured, and beyond twice this distance as imagined, in scene units.
_MEASURED_DISTANCE = 0.06
# Weight of normals in that distance, which separates the two sides of a sheet.
_NORMAL_WEIGHT = 0.1


class PlacedShape(MeanSurface):
    """A known shape at its registered placement, in scene coordinates. Its deviation is zero.

    - `name`, `probability`: of the part, or of the kind of shape.
    - `measured`: 1 where points were scanned, 0 where the shape is imagined.
    - `agreed`: 1 where most hypotheses have the same surface, 0 where few do.
    - `disputed_space`: surface of the space that other hypotheses fill.
    - `is_part`: whether it is a part at true size.
    """

    name: str
    probability: float
    measured: Float[np.ndarray, " v"]
    agreed: Float[np.ndarray, " v"]
    disputed_space: MeanSurface | None = None
    is_part: bool = True

    @property
    def caption(self) -> str:
        """Name and probability in percent, as text."""
        return f"{self.name}  {100 * self.probability:.0f} %"


def _select(tree: T, rows: int | list[int]) -> T:
    """Return the tree with only these rows of each leaf.

    NumPy selects the rows, because JAX would compile a program for each shape of a leaf.
    """
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[rows]), tree)


def placed_parts(hypotheses: PartHypotheses, count: int) -> list[PlacedShape]:
    """Return at most `count` of the likeliest parts, each at its likeliest placement."""
    shapes, weights = np.asarray(hypotheses.placed.shape), np.asarray(hypotheses.shape_weights)
    return [
        _place_shape(hypotheses.bank, hypotheses.placed, int(np.argmax(shapes == part)), float(weights[part]))
        for part in np.argsort(-weights)[:count]
        if weights[part] > 0
    ]


def likeliest_part(hypotheses: PartHypotheses, cloud: PointCloud | None = None) -> PlacedShape | None:
    """Return the likeliest part at its placement; None if "none of these" is more likely.

    Without a cloud of scanned points, its `measured` and `agreed` are 1 everywhere.
    """
    if next(iter(hypotheses.names())) == NONE:
        return None
    (part,) = placed_parts(hypotheses, 1)
    if cloud is None:
        return part
    weights, shapes = np.asarray(hypotheses.weights, np.float64)[:-1], np.asarray(hypotheses.placed.shape)
    first = int(np.argmax(shapes == hypotheses.most_likely[0]))
    likely = np.argsort(-weights, kind="stable")[:_MAX_HYPOTHESES].tolist()
    rows = [first, *(row for row in likely if row != first and weights[row] > 0)]
    return _with_hypotheses(part, hypotheses.bank, _select(hypotheses.placed, rows), weights[rows], cloud)


class LikelyKind(NamedTuple):
    """A kind of known shape, its probability, and the row of its likeliest hypothesis."""

    name: str
    probability: float
    row: int


def likely_kinds(
    bank: ShapeBank,
    hypotheses: Hypotheses,
    weights: Float[AnyArray, " h_and_none"],
    answer: Answer | None = None,
) -> list[LikelyKind]:
    """Return the kinds of the registered shapes, likeliest first.

    The list is empty if "none of these" is nearly certain.

    - `hypotheses`, `weights`: the registered shapes and their weights. The last weight is that of "none of these".
    - `answer`: probabilities of classes. If every kind is one of the classes, the weight of each kind is multiplied by
      the probability of its class, and the weights are normalised. Otherwise a picture could contradict the answer
      beside it.
    """
    weights = np.asarray(weights, np.float64)
    if weights[-1] > _MAX_NONE_PROBABILITY:
        return []
    names = [kind_of(bank.names[shape]) for shape in np.asarray(hypotheses.shape)]
    rows, kinds = dict[str, int](), dict[str, float]()
    for row in np.argsort(-weights[:-1], kind="stable").tolist():
        rows.setdefault(names[row], row)
        kinds[names[row]] = kinds.get(names[row], 0.0) + weights[row]
    if answer is not None and kinds.keys() <= set(answer.names):
        chances = dict(zip(answer.names, answer.values.tolist(), strict=True))
        total = max(sum(kinds[kind] * chances[kind] for kind in kinds), 1e-30)
        kinds = {kind: weight * chances[kind] / total for kind, weight in kinds.items()}
    return [LikelyKind(kind, kinds[kind], rows[kind]) for kind in sorted(kinds, key=lambda kind: -kinds[kind])]


def likeliest_shape(
    bank: ShapeBank, hypotheses: Hypotheses, kinds: list[LikelyKind], cloud: PointCloud
) -> PlacedShape | None:
    """Return the likeliest shape of the first of `likely_kinds`; None if there are no kinds.

    - `cloud`: the scanned points.
    """
    if not kinds:
        return None
    first, kinds = kinds[0], kinds[:_MAX_HYPOTHESES]
    shape = _place_shape(bank, hypotheses, first.row, first.probability)
    shape = dataclasses.replace(shape, name=first.name, is_part=False)
    weights = np.array([kind.probability for kind in kinds])
    return _with_hypotheses(shape, bank, _select(hypotheses, [kind.row for kind in kinds]), weights, cloud)


def _place_shape(bank: ShapeBank, hypotheses: Hypotheses, row: int, probability: float) -> PlacedShape:
    index = int(np.asarray(hypotheses.shape)[row])
    shape = _select(bank.shapes, index)
    grid = Grid(_NODES, _MARGIN * float(np.abs(shape.extremes).max()))
    triangles = level_triangles(np.array(_own_distances(shape.solid, jnp.asarray(grid.axis, jnp.float32))), grid)
    assert triangles is not None
    vertices, faces, normals = triangles
    placement = jax.tree.map(lambda rows: np.asarray(rows, np.float64)[row], hypotheses.placement)
    return PlacedShape(
        (placement.scale * vertices) @ placement.rotation.T + placement.shift,
        faces,
        unit(normals / placement.scale) @ placement.rotation.T,
        np.zeros(len(vertices)),
        bank.names[index],
        probability,
        np.ones(len(vertices)),
        np.ones(len(vertices)),
    )


def _with_hypotheses(
    shape: PlacedShape, bank: ShapeBank, hypotheses: Hypotheses, weights: Float[np.ndarray, " h"], cloud: PointCloud
) -> PlacedShape:
    """Return a copy of `shape`, the first of `hypotheses`, with `measured`, `agreed` and `disputed_space`."""
    half_extent = min(_MARGIN * float(_extent(bank, hypotheses)) + _TOLERANCE, np.pi)
    grid, coarse = Grid(_FINE_NODES, half_extent), Grid(_COARSE_NODES, half_extent)
    # A coarse grid suffices because distances are smooth. A fine one would take long for many hypotheses.
    others = np.array(_distances(bank, hypotheses, jnp.asarray(coarse.axis, jnp.float32)))
    occupancy, own_distances = np.zeros((_FINE_NODES,) * 3, others.dtype), _resample(others[0], coarse, grid)
    grid_points, agreed = (shape.vertices + half_extent).T / coarse.spacing, np.zeros(len(shape.vertices))
    weights = weights / max(weights.sum(), 1e-30)
    for weight, distance in zip(weights.tolist(), others, strict=True):
        occupancy += weight * _step(-_resample(distance, coarse, grid))
        agreed += weight * _step(2.0 * _TOLERANCE - np.abs(map_coordinates(distance, grid_points, order=1)))
    # Positive outside the disputed space, and near the shape itself.
    outside = np.maximum(4.0 * _SOFTNESS * (_MIN_DISPUTED - occupancy), _TOLERANCE - own_distances)
    measured, agreed = _measured_weight(shape, cloud), np.clip(4.0 * agreed - 1.5, 0.0, 1.0)
    disputed_space = _pieces(outside, grid, _MIN_PIECE * shape.mesh.area)
    return dataclasses.replace(shape, measured=measured, agreed=agreed, disputed_space=disputed_space)


def _step(x: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    return np.clip(0.5 + x / (4.0 * _SOFTNESS), 0.0, 1.0)


def _resample(values: _Values, coarse: Grid, fine: Grid) -> _Values:
    """Interpolate values linearly from a coarse grid to a finer grid of the same extent."""
    hats = np.stack([np.interp(fine.axis, coarse.axis, row) for row in np.eye(coarse.resolution)], axis=1)
    hats = hats.astype(values.dtype)
    for _ in range(3):
        # `tensordot` moves the new axis to the end, so that three rounds interpolate along all axes.
        values = np.tensordot(values, hats, ([0], [1]))
    return values


@program
def _extent(bank: ShapeBank, hypotheses: Hypotheses) -> Float[Array, ""]:
    """Return the largest absolute coordinate of the placed shapes."""
    corners = bank.shape(hypotheses.shape).extremes * hypotheses.placement.scale[:, None]
    rotated = jnp.einsum("hpj,hij->hpi", corners, hypotheses.placement.rotation) + hypotheses.placement.shift[:, None]
    return jnp.max(jnp.abs(rotated))


@program
def _own_distances(solid: SignedDistance, axis: Float[AnyArray, " g"]) -> Float[Array, "g g g"]:
    return on_tensor_grid(solid, axis)


@program
def _distances(bank: ShapeBank, hypotheses: Hypotheses, axis: Float[AnyArray, " g"]) -> Float[Array, "h g g g"]:
    solids = bank.shape(hypotheses.shape).solid

    def of_shape(solid_and_placement):
        solid, placement = solid_and_placement
        return on_tensor_grid(lambda x: placement.distance(solid, x), axis)

    return jax.lax.map(of_shape, (solids, hypotheses.placement))


def _measured_weight(surface: MeanSurface, cloud: PointCloud) -> Float[np.ndarray, " v"]:
    points, normals = cloud.to_numpy()
    if len(points) == 0:
        return np.zeros(len(surface.vertices))
    tree = cKDTree(np.concatenate([points, _NORMAL_WEIGHT * normals], axis=1))
    distances, _ = tree.query(np.concatenate([surface.vertices, _NORMAL_WEIGHT * surface.normals], axis=1))
    return np.clip(2.0 - distances / _MEASURED_DISTANCE, 0.0, 1.0)


def _pieces(values: Float[np.ndarray, "g g g"], grid: Grid, min_area: float) -> MeanSurface | None:
    """Return the surface where grid values are zero, without pieces smaller than `min_area`; None if empty."""
    triangles = level_triangles(values, grid)
    if triangles is None:
        return None
    surface = MeanSurface(*triangles, np.zeros(len(triangles[0])))
    label = trimesh.graph.connected_component_labels(surface.mesh.edges_unique, len(surface.vertices))
    area = np.bincount(label[surface.faces[:, 0]], surface.mesh.area_faces, label.max() + 1)
    return surface.part(area[label] >= min_area)
