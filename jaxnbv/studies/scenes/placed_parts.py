"""Known parts placed in a scene: in a random rotation, or resting on a table, perhaps beside a box."""

import dataclasses
import functools

import equinox as eqx
import jax
import numpy as np
import trimesh
from jaxtyping import Float, PRNGKeyArray
from scipy.spatial.transform import Rotation

from jaxnbv.checks import require
from jaxnbv.geometry.frame import Frame
from jaxnbv.readers import MeshFile
from jaxnbv.scanning import Obstacles, TriangleMesh
from jaxnbv.scanning.sdf import Cuboid, HalfSpace
from jaxnbv.studies.scenes.confusable import CONFUSABLE_SETS, PARTS_OF_SET, confusable_bank, confusable_meshes
from jaxnbv.studies.scenes.framing import Setup
from jaxnbv.surfaces import FreeRotation, Resting, ShapeBank, ShapePoses

_LONGEST_SIDE = 2.5
# The box beside a part, in scene units: gap between box and part, half the box's thickness, and length by which the box
# extends beyond the part.
_GAP, _HALF_THICKNESS, _OVERHANG = 0.3, 0.15, 0.2
# Seed of the order in which scenes use the parts. It does not depend on the study's seed.
_ORDER_SEED = 123


@dataclasses.dataclass(frozen=True, eq=False)
class Parts:
    """Known parts at true size, as a bank and as meshes.

    - `meshes`: the mesh of each part, in the coordinates of the bank's shapes.
    """

    bank: ShapeBank
    meshes: tuple[TriangleMesh, ...]

    @functools.cached_property
    def resting(self) -> Resting:
        """The stable poses of the parts on a table."""
        return Resting.of(self.bank)

    def choose(self, index: int) -> int:
        """Return the index of the part for the scene with this index.

        Scenes with even indices use one half of the parts, and scenes with odd indices the other half. In each half,
        no part repeats until all have been used.
        """
        half = np.random.default_rng(_ORDER_SEED).permutation(len(self.meshes))[index % 2 :: 2]
        return int(half[index // 2 % len(half)])


@functools.cache
def parts_in(files: tuple[MeshFile, ...]) -> Parts:
    """Read parts from mesh files. An unusable file is left out, and a `UserWarning` names it.

    **Raises:** `ValueError` if there is only one part.
    """
    counts: dict[str, int] = {}
    names = []
    for file in files:
        counts[file.name] = counts.get(file.name, 0) + 1
        names.append(file.name if counts[file.name] == 1 else f"{file.name} {counts[file.name]}")
    bank = ShapeBank.from_meshes([file.path for file in files], names=names, scale=1.0, up=files[0].up)
    require(len(bank) > 1, f"there is only one part, {bank.names[0]}: give a folder of at least two parts")
    file_of_name = {name.encode()[:64].decode(errors="ignore"): file for name, file in zip(names, files, strict=True)}
    meshes = (file_of_name[name].read() for name in bank.names)
    return Parts(bank, tuple(TriangleMesh(mesh.vertices / mesh.frame.scale, mesh.faces, Frame()) for mesh in meshes))


def confusable_parts(index: int) -> tuple[str, Parts, int]:
    """Return name and parts of a set of look-alike parts, and which part the scene with this index shows.

    The set is `CONFUSABLE_SETS[index % 10]`.
    """
    cycle, set_index = divmod(index, len(CONFUSABLE_SETS))
    name = CONFUSABLE_SETS[set_index]
    order = np.random.default_rng(_ORDER_SEED + set_index).permutation(PARTS_OF_SET)
    return name, Parts(confusable_bank(name), confusable_meshes(name)), int(order[cycle % PARTS_OF_SET])


class PlacedPart(eqx.Module):
    """A part placed in a scene. Its bounding box is centred and has longest side 2.5.

    - `part`: index of the part in `parts`; `parts`: all parts that the object may be, at true size.
    - `scale`: scene units per unit of the parts' coordinates.
    - `rotation`, `shift`: the placement. A point u of the part is placed at rotation (scale u) + shift.
    - `obstacles`: a table, perhaps with a box on it; None for no obstacles.
    """

    part: int = eqx.field(static=True)
    parts: Parts
    scale: float
    rotation: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, "3"]
    obstacles: Obstacles | None

    @property
    def bank(self) -> ShapeBank:
        """The bank of the parts in scene units."""
        return self.parts.bank.in_scene(Frame(scale=self.scale))

    @property
    def poses(self) -> ShapePoses:
        """Possible poses of the parts: the stable poses if there is a table, else all rotations."""
        return FreeRotation() if self.obstacles is None else self.parts.resting

    @property
    def mesh(self) -> TriangleMesh:
        """The mesh of the placed part, in scene coordinates."""
        return self.placed_mesh(self.part, self.rotation, self.shift)

    def placed_mesh(self, part: int, rotation: Float[np.ndarray, "3 3"], shift: Float[np.ndarray, "3"]) -> TriangleMesh:
        """Return the mesh, in scene coordinates, of the part with this index at a given placement."""
        mesh = self.parts.meshes[part]
        return TriangleMesh(self.scale * mesh.vertices @ np.asarray(rotation).T + shift, mesh.faces, Frame())


def place_part(parts: Parts, part: int, setup: Setup, key: PRNGKeyArray) -> PlacedPart:
    """Place a part in a random rotation or, if the setup has a table, in a random stable pose on it."""
    random = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    vertices = parts.meshes[part].vertices
    rotation = _resting(vertices, random) if setup.is_resting else Rotation.random(rng=random).as_matrix()
    rotated_vertices = vertices @ rotation.T
    low, high = rotated_vertices.min(axis=0), rotated_vertices.max(axis=0)
    scale = _LONGEST_SIDE / float((high - low).max())
    obstacles = _obstacles(0.5 * scale * (high - low), setup is Setup.HIDDEN, random) if setup.is_resting else None
    return PlacedPart(part, parts, scale, rotation, -0.5 * scale * (low + high), obstacles)


def _resting(vertices: Float[np.ndarray, "v 3"], random: np.random.Generator) -> Float[np.ndarray, "3 3"]:
    """Return the rotation of a random stable pose on a table (y is up).

    The probability of a pose is that of a dropped part to come to rest in it. The angle about y is uniform.
    """
    hull = trimesh.Trimesh(vertices, process=False).convex_hull
    matrices, probabilities = trimesh.poses.compute_stable_poses(hull)
    rest_rotation = matrices[random.choice(len(probabilities), p=probabilities / probabilities.sum())][:3, :3]
    upright = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    spin = Rotation.from_rotvec([0.0, random.uniform(0.0, 2.0 * np.pi), 0.0]).as_matrix()
    return spin @ upright @ rest_rotation


def _obstacles(half: Float[np.ndarray, "3"], has_box: bool, random: np.random.Generator) -> Obstacles:
    """Return a table below a part and, if `has_box`, a box beside the part that hides half of one side.

    - `half`: half sizes of the part's bounding box, in scene units.
    """
    table = HalfSpace(np.array([0.0, -half[1], 0.0]), np.array([0.0, 1.0, 0.0]))
    if not has_box:
        return Obstacles((table,))
    normal_axis, side_axis = random.permutation([0, 2])
    size, center = np.zeros(3), np.zeros(3)
    size[normal_axis] = _HALF_THICKNESS
    center[normal_axis] = random.choice([-1.0, 1.0]) * (half[normal_axis] + _GAP + _HALF_THICKNESS)
    size[side_axis] = 0.5 * (half[side_axis] + _OVERHANG)
    center[side_axis] = random.choice([-1.0, 1.0]) * size[side_axis]
    size[1] = half[1] + _OVERHANG
    center[1] = size[1] - half[1]
    return Obstacles((table, Cuboid(size).translate(center)))
