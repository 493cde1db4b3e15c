"""The task that asks for the object's parts."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import jaxnbv as nbv
from jaxnbv.cli.options import task_option
from jaxnbv.cli.tasks.base import Subject, Task, default_first_pose, network_option

if TYPE_CHECKING:
    from jaxnbv.networks import CloudSegmenter
    from jaxnbv.scanning.sensors import Setting

# Categories that were not in the training set of the shipped segmenter.
_UNKNOWN_TO_SEGMENTER = ("cap", "car", "knife")


@dataclass(frozen=True, kw_only=True)
class PartTask(Task):
    name = "parts"
    about = "its parts"
    example = "a procedural object of one of thirteen categories"
    until = ("parts-found=60",)
    category: Annotated[
        str,
        task_option(
            metavar="NAME",
            help="For parts: ShapeNet-part category of the object, which must stand upright along y and face x.",
        ),
    ]
    network: Annotated[Path | None, network_option] = None

    @classmethod
    def setting(cls) -> "Setting":
        from jaxnbv.studies.sensors import PART_SETTING

        return PART_SETTING

    def acquisition(self, mesh: "nbv.TriangleMesh", camera: "nbv.Camera", first: "nbv.Pose") -> "nbv.Acquisition":
        from jaxnbv.checks import require
        from jaxnbv.networks import CloudSegmenter, load_checkpoint, network_scale, part_segmenter

        if self.network is not None:
            network = load_checkpoint(self.network)
            return _part_acquisition(CloudSegmenter(network, self.category, scale=network_scale(network)))
        require(
            self.category not in _UNKNOWN_TO_SEGMENTER,
            f"--category {self.category}: the shipped segmenter was not trained on it: give --network FILE",
        )
        return _part_acquisition(part_segmenter(self.category))

    @classmethod
    def demo(cls, scene: int, seed: int) -> Subject:
        from jaxnbv.networks import CATEGORIES, part_segmenter
        from jaxnbv.studies.scenes import Split, part_scene

        part_object = part_scene(Split.TEST, scene)
        category = CATEGORIES[int(part_object.category)].name
        acquisition = _part_acquisition(part_segmenter(category))
        return Subject(category, nbv.SDFSurface(part_object.solid), acquisition, default_first_pose(), bank="parts")


def _part_acquisition(segmenter: "CloudSegmenter") -> "nbv.Acquisition":
    return nbv.ExpectedUtilityImprovement(nbv.SoftPartCount(segmenter), segmenter.num_points)
