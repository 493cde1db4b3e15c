"""The tasks that ask for the object's class."""

from abc import abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import jaxnbv as nbv
from jaxnbv.cli.tasks.base import Subject, Task, network_option

if TYPE_CHECKING:
    from jaxnbv.tasks.classification import Classifier

# Number of input points of the demo's classifier.
_NUM_POINTS = 512


@dataclass(frozen=True, kw_only=True)
class ClassTask(Task):
    """Base class of tasks whose acquisition, from `make_acquisition`, uses a classifier."""

    example = "a truck, whose cargo the first view does not show"
    until = ("sure=0.95",)
    network: Annotated[Path, network_option]

    @classmethod
    @abstractmethod
    def make_acquisition(cls, classifier: "Classifier") -> "nbv.Acquisition": ...

    def acquisition(self, mesh: "nbv.TriangleMesh", camera: "nbv.Camera", first: "nbv.Pose") -> "nbv.Acquisition":
        from jaxnbv.networks import CloudClassifier, load_checkpoint, network_scale

        network = load_checkpoint(self.network)
        return self.make_acquisition(CloudClassifier(network, scale=network_scale(network)))

    @classmethod
    def demo(cls, scene: int, seed: int) -> Subject:
        """Return a truck, the class of whose cargo is asked, and a first view that hides the cargo.

        Surfaces are imagined on the grid that was used to train the classifier.
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
        acquisition = cls.make_acquisition(pretrained_classifier("truck", side, num_points=_NUM_POINTS))
        note = f"the truck carries a {HOUSEHOLD[int(truck.label)]}, which the first view does not show"
        grid, question = nbv.Grid(64, 0.7 * side), "What does the truck carry?"
        return Subject("truck", nbv.SDFSurface(truck), acquisition, first, "truck", grid, note, question)


class CrossEntropyTask(ClassTask):
    name = "cross-entropy"
    about = "the object's class"

    @classmethod
    def make_acquisition(cls, classifier: "Classifier") -> "nbv.Acquisition":
        return nbv.CrossEntropy(classifier)


class EntropyTask(ClassTask):
    name = "entropy"
    about = "its class, by reduction of entropy"

    @classmethod
    def make_acquisition(cls, classifier: "Classifier") -> "nbv.Acquisition":
        return nbv.tasks.EntropyReduction(classifier)


class MixedTask(ClassTask):
    name = "mixed"
    about = "its class, first by cross-entropy, then by reduction of entropy"

    @classmethod
    def make_acquisition(cls, classifier: "Classifier") -> "nbv.Acquisition":
        return nbv.tasks.MixedEntropy(classifier)
