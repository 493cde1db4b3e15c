"""Known parts as they lie before a sensor: turned at random or resting on a table, a box beside them or not."""

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
# The box beside a part: how far away, half its thickness, and how far it goes beyond the part, in scene units.
_GAP, _THIN, _BEYOND = 0.3, 0.15, 0.2
# The part of each scene follows from these, whatever the study's seed.
_ORDER = 123


@dataclasses.dataclass(frozen=True, eq=False)
class Parts:
    """A bank at true size, and the meshes of its parts, in the coordinates of its shapes and at true size."""

    bank: ShapeBank
    meshes: tuple[TriangleMesh, ...]

    @functools.cached_property
    def resting(self) -> Resting:
        """How they can lie on a table."""
        return Resting.of(self.bank)

    def choose(self, index: int) -> int:
        """The part of a scene. Scenes of even and of odd numbers share none, and each part comes before any returns."""
        half = np.random.default_rng(_ORDER).permutation(len(self.meshes))[index % 2 :: 2]
        return int(half[index // 2 % len(half)])


@functools.cache
def parts_in(files: tuple[MeshFile, ...]) -> Parts:
    """The parts of files, less those that cannot be used: a `UserWarning` names each.

    **Raises:** `ValueError` for a single part, which there is nothing to tell from.
    """
    counts: dict[str, int] = {}
    names = []
    for file in files:
        counts[file.name] = counts.get(file.name, 0) + 1
        names.append(file.name if counts[file.name] == 1 else f"{file.name} {counts[file.name]}")
    bank = ShapeBank.from_meshes([file.path for file in files], names=names, scale=1.0, up=files[0].up)
    require(len(bank) > 1, f"there is one part, {bank.names[0]}: give a folder of two at least, to tell them apart")
    used = {name.encode()[:64].decode(errors="ignore"): file for name, file in zip(names, files, strict=True)}
    return Parts(bank, tuple(_at_true_size(used[name].read()) for name in bank.names))


def _at_true_size(mesh: TriangleMesh) -> TriangleMesh:
    return TriangleMesh(mesh.vertices / mesh.frame.scale, mesh.faces, Frame())


def confusable_parts(index: int) -> tuple[str, Parts, int]:
    """The set of a scene of parts that look alike, its parts, and which of them it is: sets take turns."""
    turn, which = divmod(index, len(CONFUSABLE_SETS))
    name = CONFUSABLE_SETS[which]
    order = np.random.default_rng(_ORDER + which).permutation(PARTS_OF_SET)
    return name, Parts(confusable_bank(name), confusable_meshes(name)), int(order[turn % PARTS_OF_SET])


class PlacedPart(eqx.Module):
    """A part as it lies in a scene, whose box is centred and has a longest side of 2.5.

    - `part`: its number in the bank; `parts`: all that it may be, at true size.
    - `scale`: scene units a unit of the parts. A point u of its shape stands at rotation (scale u) + shift.
    - `obstacles`: a table, and a box on it; None for none.
    """

    part: int = eqx.field(static=True)
    parts: Parts
    scale: float
    rotation: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, "3"]
    obstacles: Obstacles | None

    @property
    def bank(self) -> ShapeBank:
        """In scene units."""
        return self.parts.bank.in_scene(Frame(scale=self.scale))

    @property
    def poses(self) -> ShapePoses:
        """How the parts can lie: on a table, where there is one."""
        return FreeRotation() if self.obstacles is None else self.parts.resting

    @property
    def mesh(self) -> TriangleMesh:
        """The part as it lies, in scene coordinates."""
        return self.placed(self.part, self.rotation, self.shift)

    def placed(self, part: int, rotation: Float[np.ndarray, "3 3"], shift: Float[np.ndarray, "3"]) -> TriangleMesh:
        """The mesh of any of the parts, placed in the scene."""
        mesh = self.parts.meshes[part]
        return TriangleMesh(self.scale * mesh.vertices @ np.asarray(rotation).T + shift, mesh.faces, Frame())


def place_part(parts: Parts, part: int, setup: Setup, key: PRNGKeyArray) -> PlacedPart:
    """A part that lies as a setup says, at random."""
    random = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    vertices = parts.meshes[part].vertices
    rotation = _resting(vertices, random) if setup.is_resting else Rotation.random(rng=random).as_matrix()
    turned = vertices @ rotation.T
    low, high = turned.min(axis=0), turned.max(axis=0)
    scale = _LONGEST_SIDE / float((high - low).max())
    obstacles = _obstacles(0.5 * scale * (high - low), setup is Setup.HIDDEN, random) if setup.is_resting else None
    return PlacedPart(part, parts, scale, rotation, -0.5 * scale * (low + high), obstacles)


def _resting(vertices: Float[np.ndarray, "v 3"], random: np.random.Generator) -> Float[np.ndarray, "3 3"]:
    """The rotation of a stable pose on a table, y upward: those on which a part lands more often come up more often."""
    hull = trimesh.Trimesh(vertices, process=False).convex_hull
    matrices, shares = trimesh.poses.compute_stable_poses(hull)
    lying = matrices[random.choice(len(shares), p=shares / shares.sum())][:3, :3]
    upright = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    spin = Rotation.from_rotvec([0.0, random.uniform(0.0, 2.0 * np.pi), 0.0]).as_matrix()
    return spin @ upright @ lying


def _obstacles(half: Float[np.ndarray, "3"], has_box: bool, random: np.random.Generator) -> Obstacles:
    """The table below a part of this half size, and a box on it that hides one half of the part from one side."""
    table = HalfSpace(np.array([0.0, -half[1], 0.0]), np.array([0.0, 1.0, 0.0]))
    if not has_box:
        return Obstacles((table,))
    ahead, aside = random.permutation([0, 2])
    size, center = np.zeros(3), np.zeros(3)
    size[ahead], center[ahead] = _THIN, random.choice([-1.0, 1.0]) * (half[ahead] + _GAP + _THIN)
    size[aside] = 0.5 * (half[aside] + _BEYOND)
    center[aside] = random.choice([-1.0, 1.0]) * size[aside]
    size[1] = half[1] + _BEYOND
    center[1] = size[1] - half[1]
    return Obstacles((table, Cuboid(size).translate(center)))
