"""The task that asks which known part the object is."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import jaxnbv as nbv
from jaxnbv.cli.options import task_option
from jaxnbv.cli.tasks.base import Subject, Task

if TYPE_CHECKING:
    from jaxnbv.scanning.sdf import SignedDistance
    from jaxnbv.scanning.sensors import Setting

# If all parts are this many times smaller or larger than the object, their unit must be wrong.
_OTHER_UNIT = 20.0
# Distance in scene units at which a view shows nearly the whole housing. Direction of the first view from the housing.
_RADIUS, _FIRST = 5.5, (-0.75, -0.42, 0.5)


@dataclass(frozen=True, kw_only=True)
class IdentifyTask(Task):
    name = "identify"
    about = "which of some known parts it is, and how it lies"
    example = "one of five housings that differ at the bottom of a pocket"
    until = ("identified=0.95",)
    parts: Annotated[
        Path,
        task_option(metavar="FOLDER", help="For identify: folder with a mesh of each part that the object may be."),
    ]
    parts_scale: Annotated[
        str,
        task_option(
            metavar="UNIT",
            help="For identify: unit of the parts, a number of MESH units, or mm, cm, m, in, ft for a MESH in metres.",
            show_default="1",
        ),
    ] = "1"

    @classmethod
    def setting(cls) -> "Setting":
        from jaxnbv.scanning.sensors import USUAL_SETTING

        return USUAL_SETTING._replace(radius=_RADIUS)

    def acquisition(self, mesh: "nbv.TriangleMesh", camera: "nbv.Camera", first: "nbv.Pose") -> "nbv.Acquisition":
        return nbv.Identify()

    def bank(self, mesh: "nbv.TriangleMesh") -> "nbv.ShapeBank":
        """Return the parts of the folder, in scene units."""
        import numpy as np

        frame = mesh.world_frame
        return bank_of(self.parts, self.parts_scale, np.ptp(mesh.vertices, axis=0).max() / frame.scale).in_scene(frame)

    @classmethod
    def demo(cls, scene: int, seed: int) -> Subject:
        """Return a housing in a random rotation, and a first view that does not show how housings differ."""
        import numpy as np
        from scipy.spatial.transform import Rotation

        housings = _housings()
        meshes = [nbv.mesh_from_sdf(solid, nbv.Grid(96, 1.4)).to_trimesh() for solid in housings.values()]
        bank = nbv.ShapeBank.from_meshes(meshes, names=tuple(housings), scale=1.0, progress=False)
        index = scene % len(housings)
        name, solid = list(housings.items())[index]
        rotation = Rotation.random(random_state=scene)
        frame = nbv.Frame(2.5 / float(np.ptp(rotation.apply(bank.extremes[index]), axis=0).max()))
        surface = nbv.SDFSurface(solid.rotate(rotation.as_rotvec(), rotation.magnitude()).scale(frame.scale))
        first = nbv.look_at(_RADIUS * rotation.apply(_FIRST) / np.linalg.norm(_FIRST))
        note = f"the object is the housing with {name}; the first view does not look into its pocket"
        return Subject("housing", surface, nbv.Identify(), first, bank.in_scene(frame), note=note)


def bank_of(folder: Path, scale: str, size: float, up: str = "y") -> "nbv.ShapeBank":
    """Read the parts of a folder, and convert them to world units.

    - `scale`, `up`: unit and upward axis of the parts, as in `--parts-scale` and `--parts-up`.
    - `size`: approximate size of the object in world units.

    **Raises:** `ValueError` if all parts are far smaller or larger than the object, or if `ShapeBank.from_meshes` does.
    """
    import numpy as np

    from jaxnbv.checks import require

    bank = nbv.ShapeBank.from_meshes(folder, scale=as_unit(scale), up=up)
    sides = np.ptp(np.asarray(bank.extremes), axis=1).max(axis=1)
    require(
        bool(((sides > size / _OTHER_UNIT) & (sides < size * _OTHER_UNIT)).any()),
        f"the parts of {folder} are {sides.min():.3g} to {sides.max():.3g} long, the object about {size:.3g}: give the "
        "parts' unit, --parts-scale mm say",
    )
    return bank


def as_unit(text: str) -> float | str:
    """Convert a text such as "0.001" to a number. Return any other text, the name of a unit, unchanged."""
    try:
        return float(text)
    except ValueError:
        return text


def _housings() -> "dict[str, SignedDistance]":
    """Return housings with longest side 2.5, keyed by a description of the bosses in their pocket.

    The pocket opens upward, and the bosses are at its bottom.
    """
    from jaxnbv.scanning.sdf import Cuboid, Cylinder

    body = Cuboid([1.0, 1.25, 0.9], 0.05) - Cuboid([0.8, 0.6, 0.7]).translate([0.0, 0.85, 0.0])
    body = body - Cuboid([0.3, 0.3, 1.0]).translate([1.0, -1.25, 0.0])

    def boss(x: float, height: float = 0.6) -> "SignedDistance":
        return Cylinder(0.22, 0.5 * height).translate([x, 0.5 * height + 0.23, 0.0])

    return {
        "no boss": body,
        "a boss on the left": body | boss(-0.4),
        "a boss on the right": body | boss(0.4),
        "a tall boss": body | boss(-0.4, 0.95),
        "two bosses": body | boss(-0.4) | boss(0.4),
    }
