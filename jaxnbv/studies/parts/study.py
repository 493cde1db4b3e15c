"""Studies that count the views until all semantic parts of an object are found (the paper's Table 1).

`PartStudy` uses procedural objects, which a network segments. `MeshPartStudy` uses mesh files whose nodes are parts,
which an oracle segments.
"""

from pathlib import Path
from typing import Any, ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Int

from jaxnbv.checks import require
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.networks import CATEGORIES, CloudSegmenter, part_segmenter
from jaxnbv.readers.class_meshes import MeshFile, interleave, mesh_files
from jaxnbv.sampler import SurfaceSampler
from jaxnbv.scanning import Grid, MeshParts, SDFSurface, load_parts, scan
from jaxnbv.scanning.mesh_files import read_nodes
from jaxnbv.studies.engine.known import keep_shapes
from jaxnbv.studies.engine.measures import Record
from jaxnbv.studies.engine.study import Scene, Study
from jaxnbv.studies.parts.discovery import NETWORK_POINTS, TARGETS, NearestPart, PartDiscoveryStudy
from jaxnbv.studies.scenes import Split, part_scene
from jaxnbv.surfaces.known_shapes import kind_of
from jaxnbv.tasks import part_counts

# The grid on which distances from the parts are stored. The object's longest side is 2.5.
_GRID = Grid(64, 1.4)


class PartMesh(eqx.Module):
    """The parts of a mesh, and the oracle that segments them."""

    parts: MeshParts
    oracle: NearestPart


class MeshPartStudy(PartDiscoveryStudy):
    """Part discovery on mesh files, segmented by the oracle `NearestPart` in place of a network.

    The utility counts all parts. The measures count only parts that can be found: the oracle assigns at least 100
    points (the largest N_target) to such a part when it segments the scans from all candidates together. The study has
    the settings of `PartDiscoveryStudy`, and:

    - `meshes`: mesh files whose nodes are parts.
    - `room`: largest number of parts of any mesh.
    """

    explanation: ClassVar[str] = (
        f"{PartDiscoveryStudy.explanation}\nAn oracle assigns each point to the nearest part. A part counts only if "
        f"the oracle assigns\n{max(TARGETS)} of {NETWORK_POINTS} points of the scans from all candidates to the part."
    )
    seed: ClassVar[int] = 12

    room: int = eqx.field(static=True, kw_only=True)

    @classmethod
    def configured(cls, model: str, views: int, quick: bool, **options: Any) -> dict[str, Study]:
        counts = _part_counts(options.pop("meshes"))
        return super().configured(model, views, quick, meshes=tuple(counts), room=max(counts.values()), **options)

    @classmethod
    def files_in(cls, folder: str | Path) -> tuple[MeshFile, ...]:
        """Return the meshes that have at least two nodes, alternating between the subfolders.

        The name of a mesh includes the name of its subfolder.

        **Raises:** `ValueError` if there is no such mesh, or if a mesh cannot be read.
        """
        return tuple(_part_counts(folder))

    def scene(self, index: int) -> Scene:
        """Return the scene of a mesh file. Its `task` is a `PartMesh`."""
        file = self.mesh_file(index)
        assert file is not None
        parts = load_parts(file.path)
        oracle = NearestPart.of(parts, self.room, _GRID, NETWORK_POINTS)
        return Scene(index, file.name, parts.mesh, PartMesh(parts, oracle))

    def segmenter_of(self, scene: Scene, num_points: int | None = None) -> NearestPart:
        oracle = scene.task.oracle
        return NearestPart(oracle.distances, oracle.grid, num_points or oracle.num_points)

    def true_parts(self, scene: Scene, points: Float[Array, "n 3"]) -> Int[Array, " n"]:
        return scene.task.oracle.nearest(points)

    def truth(self, scene: Scene) -> list[int]:
        """Return the indices of the parts that can be found, see `MeshPartStudy`.

        **Raises:** `ValueError` if no part can be found.
        """
        scans = scan(scene.surface, self.imagined_camera, self.candidates.poses())
        cloud = PointCloud(scans.points.reshape(-1, 3), scans.normals.reshape(-1, 3), scans.mask.reshape(-1))
        counts = part_counts(scene.task.oracle(cloud))
        visible_parts = [int(part) for part in np.flatnonzero(np.asarray(counts) >= max(TARGETS))]
        require(len(visible_parts) > 0, f"{scene.name} has no part that shows {max(TARGETS)} points: leave it out")
        return visible_parts

    def scene_record(self, scene: Scene, truth: list[int], first: int) -> Record:
        names = scene.task.parts.names
        category = Path(self.meshes[scene.index].path).parent.name
        return {"name": scene.name, "category": category, "parts": [names[part] for part in truth], "of": len(names)}


def _part_counts(folder: str | Path) -> dict[MeshFile, int]:
    """Return the number of nodes of each mesh of `MeshPartStudy.files_in`. Each file is read once."""
    by_class: dict[str, list[tuple[MeshFile, int]]] = {}
    for file in mesh_files(folder):
        if (count := len(read_nodes(file.path))) > 1:
            kind = Path(file.path).parent.name
            by_class.setdefault(kind, []).append((file._replace(name=f"{kind} {file.name}"), count))
    require(len(by_class) > 0, f"the folder {folder} holds no mesh of two nodes or more: each part must be a node")
    return dict(interleave(by_class.values()))


class PartStudy(PartDiscoveryStudy):
    """Part discovery on procedural objects with the shipped network.

    It has the settings of `PartDiscoveryStudy`, and:

    - `segmenter`: segmenter of clouds in scene coordinates. The object's category replaces the segmenter's category.
    - `split`: split from which the scenes come. Tune settings on the validation split.
    """

    bank: ClassVar[str] = "parts"

    segmenter: CloudSegmenter = eqx.field(kw_only=True)
    split: Split = eqx.field(static=True, default=Split.TEST)

    @classmethod
    def configured(
        cls, model: str, views: int, quick: bool, meshes: str | Path | None = None, **options: Any
    ) -> dict[str, Study]:
        """Return one study, under the key "". It is a `MeshPartStudy` if `meshes` is a folder."""
        if meshes is not None:
            return MeshPartStudy.configured(model, views, quick, meshes=meshes, **options)
        return super().configured(model, views, quick, segmenter=part_segmenter(category=0), **options)

    def scene(self, index: int) -> Scene:
        """Return the scene of a procedural object. Its `task` is a `PartScene`."""
        part = part_scene(self.split, index)
        return Scene(index, CATEGORIES[int(part.category)].name, SDFSurface(part.solid), part)

    def segmenter_of(self, scene: Scene, num_points: int | None = None) -> CloudSegmenter:
        base = self.segmenter
        return CloudSegmenter(base.network, scene.task.category, num_points or base.num_points, base.scale)

    def sampler_of(self, scene: Scene) -> SurfaceSampler:
        """Return the study's sampler, restricted to the known shapes of the object's category."""
        return keep_shapes(self.sampler, lambda name: kind_of(name) == scene.name)

    def true_parts(self, scene: Scene, points: Float[Array, "n 3"]) -> Int[Array, " n"]:
        return scene.task.solid.part_labels(points)

    def truth(self, scene: Scene) -> list[int]:
        """Return the labels of the object's parts."""
        return [int(label) for label in np.flatnonzero(np.asarray(scene.task.parts))]

    def scene_record(self, scene: Scene, truth: list[int], first: int) -> Record:
        category = CATEGORIES[int(scene.task.category)]
        parts = [category.parts[label - category.first_label] for label in truth]
        return {"name": scene.name, "split": self.split.value, "category": category.name, "parts": parts}
