"""The study of the loaded truck: its outside is most of what can be seen, and says nothing of the cargo's class."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import equinox as eqx

from jaxnbv.checks import require
from jaxnbv.scanning import load_mesh
from jaxnbv.studies.classification.measures import HITS_EXPLAINED, charts_of, hits_and_diagnostics, seen_explained
from jaxnbv.studies.classification.study import ClassificationStudy
from jaxnbv.studies.engine.measures import Measure
from jaxnbv.studies.engine.meshes import mesh_files
from jaxnbv.studies.engine.study import Chart, Study
from jaxnbv.studies.readers import MeshFile
from jaxnbv.studies.scenes import CLASS_SETS, ClassSet
from jaxnbv.studies.scenes.class_object import ClassMesh
from jaxnbv.studies.scenes.splits import scene_key
from jaxnbv.studies.scenes.truck_meshes import loaded_truck


class TruckStudy(ClassificationStudy):
    """The class of a truck's cargo, from a random first view. Settings as of `ClassificationStudy`, and

    - `trucks`: files of trucks that carry what `meshes` names.
    """

    title: ClassVar[str] = "The class of a truck's cargo"
    explanation: ClassVar[str] = (
        f"{HITS_EXPLAINED}{seen_explained('cargo')}\nDiagnostics are by the view being chosen, in ( ) their scenes."
    )
    objects: ClassVar[ClassSet] = CLASS_SETS["truck"]
    cue: ClassVar[str] = "cargo"
    bank: ClassVar[str] = "truck"
    network: ClassVar[str] = "truck"
    fed: ClassVar[tuple[int, int]] = (2048, 1024)
    measures: ClassVar[tuple[Measure, ...]] = hits_and_diagnostics(cue)
    charts: ClassVar[Mapping[str, Chart]] = charts_of(cue, "first_views")
    seed: ClassVar[int] = 11

    num_points: int = eqx.field(static=True, default=1024)
    trucks: tuple[str, ...] = eqx.field(static=True, default=())

    def __check_init__(self):
        require(
            bool(self.trucks) == bool(self.meshes),
            f"{len(self.meshes)} meshes of cargo and {len(self.trucks)} of trucks: give both, or none",
        )

    @classmethod
    def configured(cls, model: str, views: int, quick: bool, **options: Any) -> dict[str, Study]:
        """
        - `meshes`: a folder with a folder `trucks` of meshes, and those of the cargo's classes, see `class_meshes`.

        **Raises:** `ValueError` as of a `ClassificationStudy`, or if there is no truck.
        """
        if "meshes" in options:
            options["trucks"] = mesh_files(Path(options["meshes"]) / "trucks")
        return super().configured(model, views, quick, **options)

    def of_mesh(self, file: MeshFile, index: int) -> ClassMesh:
        """The cargo on the bed of one of the trucks, which take turns."""
        truck = load_mesh(self.trucks[index % len(self.trucks)])
        return loaded_truck(truck, file.read(), file.label, scene_key(self.seed, self.split, index))
