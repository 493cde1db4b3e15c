"""The tasks that ask for the object's class."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import jaxnbv as nbv
from jaxnbv.cli.tasks.base import Subject, Task, network_option

# Number of input points of the demo's classifier.
_NUM_POINTS = 512


@dataclass(frozen=True, kw_only=True)
class ClassTask(Task):
    """Base class of tasks whose acquisition uses a classifier.

    - `kind`: name of the acquisition in `jaxnbv.tasks`.
    """

    example = "a truck, whose cargo the first view does not show"
    until = ("sure=0.95",)
    kind: ClassVar[str]
    network: Annotated[Path, network_option]

    def acquisition(self, mesh: "nbv.TriangleMesh", camera: "nbv.Camera", first: "nbv.Pose") -> "nbv.Acquisition":
        from jaxnbv.networks import CloudClassifier, load_checkpoint, network_scale

        network = load_checkpoint(self.network)
        return getattr(nbv.tasks, self.kind)(CloudClassifier(network, scale=network_scale(network)))

    @classmethod
    def demo(cls, scene: int, seed: int) -> Subject:
        """Return a truck whose cargo is the question, and a first view from above that hides the cargo.

        Surfaces are imagined on the same grid as in the classifier's training.
        """
        import jax
        import numpy as np

        from jaxnbv.networks import pretrained_classifier
        from jaxnbv.search.candidates import sphere_candidates
        from jaxnbv.studies.scenes import HOUSEHOLD, Framing, Split, hidden_view, truck_scene

        truck = truck_scene(Split.TEST, scene, is_rotated=False)
        poses = sphere_candidates(120)
        first = hidden_view(truck, jax.random.key(seed), poses=poses[np.asarray(poses.position[:, 1]) > 0])
        side = Framing.CLOSE_UP.longest_side
        acquisition = getattr(nbv.tasks, cls.kind)(pretrained_classifier("truck", side, num_points=_NUM_POINTS))
        note = f"the truck carries a {HOUSEHOLD[int(truck.label)]}, which the first view does not show"
        grid, question = nbv.Grid(64, 0.7 * side), "What does the truck carry?"
        return Subject("truck", nbv.SDFSurface(truck), acquisition, first, "truck", grid, note, question)


class CrossEntropyTask(ClassTask):
    name = "cross-entropy"
    about = "the object's class"
    kind = "CrossEntropy"


class EntropyTask(ClassTask):
    name = "entropy"
    about = "its class, by reduction of entropy"
    kind = "EntropyReduction"


class MixedTask(ClassTask):
    name = "mixed"
    about = "its class, first by cross-entropy, then by reduction of entropy"
    kind = "MixedEntropy"
