"""The studies of semantic parts: how many views until all parts of an object are found? The paper's Table 1.

Objects are procedural and a network tells their parts, or they are mesh files whose nodes are parts and an oracle does.
"""

from pathlib import Path
from typing import Any, ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Int

from jaxnbv.checks import require
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.networks import CATEGORIES, CloudSegmenter, part_segmenter
from jaxnbv.readers.class_meshes import MeshFile, mesh_files, taking_turns
from jaxnbv.sampler import SurfaceSampler
from jaxnbv.scanning import Grid, MeshParts, SDFSurface, load_parts, scan
from jaxnbv.scanning.mesh_files import read_nodes
from jaxnbv.studies.engine.known import knowing_those
from jaxnbv.studies.engine.measures import Record
from jaxnbv.studies.engine.study import Scene, Study
from jaxnbv.studies.parts.discovery import NETWORK_POINTS, TARGETS, NearestPart, PartDiscoveryStudy
from jaxnbv.studies.scenes import Split, part_scene
from jaxnbv.surfaces.known_shapes import kind_of
from jaxnbv.tasks import part_counts

# Where distances from the parts are known: the object's longest side is 2.5.
_GRID = Grid(64, 1.4)


class PartMesh(eqx.Module):
    """A mesh and what tells its parts apart."""

    parts: MeshParts
    oracle: NearestPart


class MeshPartStudy(PartDiscoveryStudy):
    """The parts of real objects, told by `NearestPart`, so that planning is seen without the network's errors. Settings
    as of `PartDiscoveryStudy`, and

    - `meshes`: files whose nodes are parts; `room`: for as many parts as any has.

    The planner is asked for all parts. It is measured on those that can be found: of which all candidates together show
    as many points as the largest N_target asks.
    """

    explanation: ClassVar[str] = (
        f"{PartDiscoveryStudy.explanation}\nAn oracle gives each point to the nearest part; asked is for those of "
        f"which\nall candidates together show {max(TARGETS)} points of {NETWORK_POINTS}."
    )
    seed: ClassVar[int] = 12

    room: int = eqx.field(static=True, kw_only=True)

    @classmethod
    def configured(cls, model: str, views: int, quick: bool, **options: Any) -> dict[str, Study]:
        room = max(len(read_nodes(file.path)) for file in cls.files_in(options["meshes"]))
        return super().configured(model, views, quick, room=room, **options)

    @classmethod
    def files_in(cls, folder: str | Path) -> tuple[MeshFile, ...]:
        """Those of two nodes or more, by folder and name; folders take turns.

        **Raises:** `ValueError` if there is no such mesh, or one cannot be read.
        """
        by_class: dict[str, list[MeshFile]] = {}
        for file in mesh_files(folder):
            if len(read_nodes(file.path)) > 1:
                kind = Path(file.path).parent.name
                by_class.setdefault(kind, []).append(file._replace(name=f"{kind} {file.name}"))
        require(len(by_class) > 0, f"the folder {folder} holds no mesh of two nodes or more: each part must be a node")
        return tuple(taking_turns(by_class.values()))

    def scene(self, index: int) -> Scene:
        """An object; its task is the `PartMesh`."""
        file = self.file(index)
        assert file is not None
        parts = load_parts(file.path)
        oracle = NearestPart.of(parts, self.room, _GRID, NETWORK_POINTS)
        return Scene(index, file.name, parts.mesh, PartMesh(parts, oracle))

    def segmenter_of(self, scene: Scene, num_points: int | None = None) -> NearestPart:
        """The oracle."""
        oracle = scene.task.oracle
        return NearestPart(oracle.distances, oracle.grid, num_points or oracle.num_points)

    def true_parts(self, scene: Scene, points: Float[Array, "n 3"]) -> Int[Array, " n"]:
        return scene.task.oracle.nearest(points)

    def truth(self, scene: Scene) -> list[int]:
        """The parts that can be found."""
        seen = scan(scene.surface, self.imagined_camera, self.candidates.poses())
        joined = PointCloud(seen.points.reshape(-1, 3), seen.normals.reshape(-1, 3), seen.mask.reshape(-1))
        counts = part_counts(scene.task.oracle(joined))
        found = [int(part) for part in np.flatnonzero(np.asarray(counts) >= max(TARGETS))]
        require(len(found) > 0, f"{scene.name} has no part that shows {max(TARGETS)} points: leave it out")
        return found

    def facts(self, scene: Scene, truth: list[int], first: int) -> Record:
        names = scene.task.parts.names
        category = Path(self.meshes[scene.index].path).parent.name
        return {"name": scene.name, "category": category, "parts": [names[part] for part in truth], "of": len(names)}


class PartStudy(PartDiscoveryStudy):
    """The parts of procedural objects by the shipped network. Settings as of `PartDiscoveryStudy`, and

    - `segmenter`: of clouds in scene coordinates; its category is replaced by that of each scene's object.
    - `split`: which scenes; tune on those of the validation split.
    """

    bank: ClassVar[str] = "parts"

    segmenter: CloudSegmenter = eqx.field(kw_only=True)
    split: Split = eqx.field(static=True, default=Split.TEST)

    @classmethod
    def configured(
        cls, model: str, views: int, quick: bool, meshes: str | Path | None = None, **options: Any
    ) -> dict[str, Study]:
        """With a folder of meshes, that of their parts."""
        if meshes is not None:
            return MeshPartStudy.configured(model, views, quick, meshes=meshes, **options)
        return super().configured(model, views, quick, segmenter=part_segmenter(category=0), **options)

    def scene(self, index: int) -> Scene:
        """An object; its task is the `PartScene`."""
        made = part_scene(self.split, index)
        return Scene(index, CATEGORIES[int(made.category)].name, SDFSurface(made.solid), made)

    def segmenter_of(self, scene: Scene, num_points: int | None = None) -> CloudSegmenter:
        """The network, told the object's category."""
        given = self.segmenter
        return CloudSegmenter(given.network, scene.task.category, num_points or given.num_points, given.scale)

    def sampler_of(self, scene: Scene) -> SurfaceSampler:
        """As the network's, with the shapes of the object's category."""
        return knowing_those(self.sampler, lambda name: kind_of(name) == scene.name)

    def true_parts(self, scene: Scene, points: Float[Array, "n 3"]) -> Int[Array, " n"]:
        return scene.task.solid.part_labels(points)

    def truth(self, scene: Scene) -> list[int]:
        """The labels of the parts that the object has."""
        return [int(label) for label in np.flatnonzero(np.asarray(scene.task.parts))]

    def facts(self, scene: Scene, truth: list[int], first: int) -> Record:
        category = CATEGORIES[int(scene.task.category)]
        parts = [category.parts[label - category.first_label] for label in truth]
        return {"name": scene.name, "split": self.split.value, "category": category.name, "parts": parts}
