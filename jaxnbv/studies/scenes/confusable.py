"""Sets of eight parts that look alike. The parts of a set differ in one feature that few views show.

Lengths are in scene units. Along each axis, all parts lie between -1.35 and 1.35.
"""

import functools
import operator
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxnbv.geometry.frame import Frame
from jaxnbv.programs import program
from jaxnbv.scanning import Grid, TriangleMesh
from jaxnbv.scanning.mesh import level_triangles
from jaxnbv.scanning.sdf import Cuboid, Cylinder, Sampled, SignedDistance
from jaxnbv.surfaces import ShapeBank

PARTS_OF_SET = 8
# Walls, handles and ribs are at least 0.09 thick, about two cells of the bank's grid. The grid of the meshes is finer.
_BANK_GRID, _MESH_GRID = Grid(64, 1.5), Grid(100, 1.4)
# Smallest distance between a part and the faces of the bank's grid.
_PADDING = 0.15
# The pocket of a housing: x of its centre, y of its floor, and y of the floor if it has holes. A deep floor would hide
# the holes.
_POCKET_X, _POCKET_FLOOR, _SHALLOW_FLOOR = 0.15, 0.05, 0.45
# Places in the pocket: x and z relative to the pocket's centre.
_SIDES = [(-0.25, 0.0), (0.25, 0.0), (0.0, 0.15), (0.0, -0.15)]


def _housing(side: float = 1.0, floor: float = _POCKET_FLOOR) -> SignedDistance:
    """Make a block with a pocket that is open above, and a notch at a corner that breaks the symmetry.

    - `side`: 1, or -1 for the mirror image; `floor`: y of the pocket's floor.
    """
    pocket = Cuboid([0.42, 0.7, 0.3]).translate([side * _POCKET_X, floor + 0.7, 0.0])
    notch = Cuboid([0.2, 0.2, 0.2]).translate([side * 0.75, -1.25, 0.55])
    return Cuboid([0.75, 1.25, 0.55]) - pocket - notch


def _bosses() -> list[SignedDistance]:
    """Make blocks with a pocket. The position, radius and height of a boss on the pocket's floor differ."""
    variants = [(x, z, 0.12, 0.25) for x, z in (*_SIDES, (0.0, 0.0))]
    variants += [(0.0, 0.0, 0.12, 0.45), (0.0, 0.0, 0.22, 0.25), (-0.25, 0.15, 0.1, 0.4)]
    return [
        _housing() | Cylinder(r, h).translate([_POCKET_X + x, _POCKET_FLOOR + h - 0.05, z]) for x, z, r, h in variants
    ]


def _bores() -> list[SignedDistance]:
    """Make blocks with a pocket. The position and radius of a blind hole in the pocket's floor differ."""
    variants = [(x, z, 0.12) for x, z in (*_SIDES, (0.0, 0.0))]
    variants += [(0.0, 0.0, 0.22), (-0.25, 0.15, 0.12), (0.25, 0.15, 0.12)]
    return [
        _housing(floor=_SHALLOW_FLOOR) - Cylinder(r, 0.35).translate([_POCKET_X + x, _SHALLOW_FLOOR - 0.25, z])
        for x, z, r in variants
    ]


def _ribs() -> list[SignedDistance]:
    """Make blocks with a pocket. The position and direction of a rib on the pocket's floor differ."""
    lengthwise = [(x, 0.0, 90.0) for x in (-0.28, 0.0, 0.28)]
    crosswise = [(0.0, z, 0.0) for z in (-0.2, 0.0, 0.2)]
    diagonal = [(0.0, 0.0, 45.0), (0.0, 0.0, -45.0)]
    rib, up = Cuboid([0.28, 0.15, 0.06]), [0.0, 1.0, 0.0]
    return [
        _housing() | rib.rotate(up, np.radians(angle)).translate([_POCKET_X + x, _POCKET_FLOOR + 0.1, z])
        for x, z, angle in (*lengthwise, *crosswise, *diagonal)
    ]


def _connectors() -> list[SignedDistance]:
    """Make blocks that differ only in the size and position of a connector on the floor of a pocket."""
    variants = [(half, deep, 0.0, 0.0) for half, deep in ((0.3, 0.1), (0.1, 0.22), (0.2, 0.2), (0.12, 0.12))]
    variants += [(0.16, 0.1, x, z) for z in (0.15, -0.15) for x in (-0.22, 0.22)]
    return [
        _housing() | Cuboid([half, 0.2, deep]).translate([_POCKET_X + x, _POCKET_FLOOR + 0.15, z])
        for half, deep, x, z in variants
    ]


def _pins() -> list[SignedDistance]:
    """Make blocks with a pocket, and with pins at two to four of four positions on the pocket's floor."""
    places = [(-0.24, -0.15), (-0.24, 0.15), (0.24, -0.15), (0.24, 0.15)]
    patterns = ["1111", "0111", "1011", "1101", "1110", "1001", "0110", "1010"]

    def part(pattern: str) -> SignedDistance:
        # An absent pin is placed inside the block, because all parts of a set need the same structure.
        heights = [_POCKET_FLOOR + (0.2 if digit == "1" else -0.6) for digit in pattern]
        pins = [Cylinder(0.1, 0.25).translate([_POCKET_X + x, y, z]) for (x, z), y in zip(places, heights, strict=True)]
        return functools.reduce(operator.or_, pins, _housing())

    return [part(pattern) for pattern in patterns]


def _channels() -> list[SignedDistance]:
    """Make blocks with a channel and a boss on one of its walls. The wall and the place along it differ."""
    block = Cuboid([0.7, 0.6, 1.25]) - Cuboid([0.28, 0.28, 1.5]).translate([0.0, 0.1, 0.0])
    block = block - Cuboid([0.2, 0.2, 0.2]).translate([0.7, -0.6, 1.25])
    boss = Cuboid([0.12, 0.12, 0.12])
    return [block | boss.translate([x, 0.0, z]) for x in (-0.24, 0.24) for z in (-0.6, -0.2, 0.2, 0.6)]


def _cup(floor: float, size: float = 1.0) -> SignedDistance:
    wall, top = 0.12 * size, 1.5
    inside = Cylinder(0.7 * size - wall, 0.5 * (top - floor)).translate([0.0, 0.5 * (top + floor), 0.0])
    return Cylinder(0.7 * size, 1.25 * size) - inside


def _cups() -> list[SignedDistance]:
    """Make cups that differ in the height of their floor, which is not visible from outside."""
    return [_cup(floor) for floor in np.linspace(-1.1, -0.05, PARTS_OF_SET)]


def _sizes() -> list[SignedDistance]:
    """Make cups of the same shape, whose sizes decrease by a factor of 1.04 from one cup to the next."""
    return [_cup(-1.1 * size, size) for size in 1.04 ** -np.arange(PARTS_OF_SET)]


def _mugs() -> list[SignedDistance]:
    """Make mugs whose handles differ in height and length. The body of a mug hides its handle from behind."""

    def part(y: float, half: float) -> SignedDistance:
        hole = Cuboid([0.12, half - 0.1, 0.2]).translate([0.82, y, 0.0])
        grip = Cuboid([0.22, half, 0.1]).translate([0.86, y, 0.0]) - hole
        # Cut the handle off at the wall. Otherwise it would be visible inside the mug.
        return (_cup(-1.1) | grip - Cylinder(0.65, 1.5)).translate([-0.19, 0.0, 0.0])

    return [part(y, half) for half in (0.2, 0.4) for y in (-0.6, -0.2, 0.2, 0.6)]


def _mirrored() -> list[SignedDistance]:
    """Make four blocks with a boss in a pocket, and the mirror image of each."""
    return [
        _housing(side) | Cylinder(0.12, 0.25).translate([side * (_POCKET_X + x), _POCKET_FLOOR + 0.2, z])
        for side in (1.0, -1.0)
        for x, z in _SIDES
    ]


_SETS: dict[str, Callable[[], list[SignedDistance]]] = {
    "boss": _bosses,
    "bore": _bores,
    "rib": _ribs,
    "connector": _connectors,
    "pins": _pins,
    "channel": _channels,
    "cup": _cups,
    "mug": _mugs,
    "mirror": _mirrored,
    "size": _sizes,
}
CONFUSABLE_SETS = tuple(_SETS)
"""Names of all sets."""
HIDDEN_CUES = ("boss", "bore", "rib", "connector", "pins", "channel", "cup")
"""Names of the sets whose parts look the same from at least two thirds of all directions."""


def confusable_solids(name: str) -> list[SignedDistance]:
    """Return the parts of a set of `CONFUSABLE_SETS` as solids, all with the same pytree structure."""
    return _SETS[name]()


@functools.cache
def confusable_meshes(name: str) -> tuple[TriangleMesh, ...]:
    """Return the parts of a set of `CONFUSABLE_SETS` as meshes. Their edges are rounded by about 0.03."""
    values = [np.array(_values(solid, _nodes(_MESH_GRID))) for solid in confusable_solids(name)]
    triangles = [level_triangles(rows, _MESH_GRID) for rows in values]
    return tuple(TriangleMesh(mesh[0], mesh[1], Frame()) for mesh in triangles if mesh is not None)


@functools.cache
def confusable_bank(name: str) -> ShapeBank:
    """Return the parts of a set of `CONFUSABLE_SETS` as a bank at true size.

    It is stored on a grid, because a search over the solids themselves (set operations) takes minutes to compile.
    """
    nodes = _nodes(_BANK_GRID)
    low, spacing = np.full(3, -_BANK_GRID.half_extent), _BANK_GRID.spacing
    solids = [Sampled(_values(solid, nodes), low, spacing, _PADDING) for solid in confusable_solids(name)]
    return ShapeBank.of(solids, [f"{name} {index}" for index in range(len(solids))], is_true_size=True)


def _nodes(grid: Grid) -> Float[Array, "g g g 3"]:
    axis = jnp.asarray(grid.axis, jnp.result_type(float))
    return jnp.stack(jnp.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)


# A compiled program, which all solids of one set share.
@program
def _values(solid: SignedDistance, nodes: Float[Array, "*n 3"]) -> Float[Array, "*n"]:
    return solid(nodes)
