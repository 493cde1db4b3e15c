"""The studies of classes by what their objects are: which methods' views tell the class, and how soon?

Of a pyramid its base has a pattern. Of a loaded truck the outside is most of what can be seen, and says nothing of the
cargo. Of household objects, the paper's sanity check, and of scanned fruits, from its supplement, all tells the class.
"""

from pathlib import Path
from typing import Any, ClassVar

import equinox as eqx
import numpy as np

from jaxnbv.checks import require
from jaxnbv.readers import MeshFile
from jaxnbv.readers.class_meshes import mesh_files
from jaxnbv.studies.classification.study import BASELINES, ClassificationStudy, Truth
from jaxnbv.studies.engine.measures import Claim, Record
from jaxnbv.studies.engine.study import Scene, Study
from jaxnbv.studies.scenes import (
    HOUSEHOLD,
    PATTERNS,
    ClassSet,
    Framing,
    Pyramid,
    household_scene,
    pyramid_scene,
    truck_scene,
)
from jaxnbv.studies.scenes.class_object import ClassMesh, choose_hidden
from jaxnbv.studies.scenes.splits import scene_key
from jaxnbv.studies.scenes.truck_meshes import loaded_truck

# Degrees. Of the cameras from which the pattern cannot be seen two fifths lie in each of the first two, a fifth in the
# last.
_ANGLES = (0, 110, 140)


class PyramidStudy(ClassificationStudy):
    """The class of a pyramid whose pattern the first view does not show. Settings as of `ClassificationStudy`."""

    title: ClassVar[str] = "The class of a pyramid"
    objects: ClassVar[ClassSet] = ClassSet(PATTERNS, pyramid_scene)
    cue: ClassVar[str] = "pattern"
    network: ClassVar[str] = "pyramid"
    framings: ClassVar[tuple[Framing, ...]] = tuple(Framing)
    solid: ClassVar[bool] = True
    bank: ClassVar[str] = "pyramid"
    seed: ClassVar[int] = 2

    @classmethod
    def group(cls, record: Record) -> str:
        """By the first view's angle from the base's normal."""
        least = max(angle for angle in _ANGLES if angle <= record["angle"])
        return f"first view at {least:03d}° or more from the base's normal"

    def facts(self, scene: Scene, truth: Truth, first: int) -> Record:
        """With the first view's angle from the base's normal, in degrees: at 180 it looks from behind the apex."""
        direction = np.asarray(self.candidates.poses().position[first])
        # The base looks along -z of the pyramid's own frame.
        assert isinstance(truth.thing, Pyramid)
        outward = -np.asarray(truth.thing.solid.rotation)[:, 2]
        cosine = np.clip(direction @ outward / np.linalg.norm(direction), -1.0, 1.0)
        return super().facts(scene, truth, first) | {"angle": float(np.degrees(np.arccos(cosine)))}

    def first_view(self, scene: Scene) -> int:
        """A random one of the candidates that do not show the pattern, but something, as `first` asks."""
        scans = scene.task.scans
        enough = [self.shows_enough(scene, scans[index]) for index in range(self.num_candidates)]
        require(any(enough), f"none of {self.num_candidates} candidates shows enough of {scene.name}: ask for more")
        return choose_hidden(np.where(enough, scene.task.pixels, 1), scans, self.key(scene.index, "first"))


class TruckStudy(ClassificationStudy):
    """The class of a truck's cargo, from a random first view. Settings as of `ClassificationStudy`, and

    - `trucks`: files of trucks that carry what `meshes` names.
    """

    title: ClassVar[str] = "The class of a truck's cargo"
    objects: ClassVar[ClassSet] = ClassSet(HOUSEHOLD, truck_scene)
    cue: ClassVar[str] = "cargo"
    bank: ClassVar[str] = "truck"
    network: ClassVar[str] = "truck"
    fed: ClassVar[tuple[int, int]] = (2048, 1024)
    seed: ClassVar[int] = 11

    num_points: int = eqx.field(static=True, default=1024)
    trucks: tuple[MeshFile, ...] = eqx.field(static=True, default=())

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
        truck = self.trucks[index % len(self.trucks)].read()
        return loaded_truck(truck, file.read(), file.label, scene_key(self.seed, self.split, index))


class HouseholdStudy(ClassificationStudy):
    """The class of a household object, one of ten that are told by their global shape, for which any views will do;
    from a random first view. Settings as of `ClassificationStudy`."""

    title: ClassVar[str] = "The class of a household object"
    objects: ClassVar[ClassSet] = ClassSet(HOUSEHOLD, household_scene)
    network: ClassVar[str] = "household"
    bank: ClassVar[str] = "household"
    seed: ClassVar[int] = 12
    claims: ClassVar[tuple[Claim, ...]] = (
        Claim("Where global features tell the class, cross-entropy is as good.", "first", 2, BASELINES, ahead=False),
    )


class OmniObject3DStudy(ClassificationStudy):
    """The class of a scanned fruit, which is told by what is small on it, from a random first view, on meshes and by a
    classifier of the user's. Settings as of `ClassificationStudy`."""

    title: ClassVar[str] = "The class of a fruit"
    objects: ClassVar[ClassSet] = ClassSet(("apple", "lemon", "mango", "mushroom", "orange"))
    network: ClassVar[str] = ""
    solid: ClassVar[bool] = True
    seed: ClassVar[int] = 14

    @classmethod
    def configured(cls, model: str, views: int, quick: bool, **options: Any) -> dict[str, Study]:
        """
        **Raises:** `ValueError` as of a `ClassificationStudy`, or if `meshes` or `classifier` is not given.
        """
        needed = {
            "meshes": f"--meshes FOLDER, a folder with a folder of meshes for each of {', '.join(cls.objects.classes)}",
            "classifier": "--classifier FILE, the checkpoint of a network that tells these apart, such as a PointNet++ "
            "that was trained in PyTorch",
        }
        missing = [text for name, text in needed.items() if name not in options]
        require(not missing, f"nothing ships for the study omniobject3d: give {', and '.join(missing)}")
        return super().configured(model, views, quick, **options)
