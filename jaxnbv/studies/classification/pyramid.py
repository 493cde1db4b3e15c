"""The study of the synthetic pyramid: which methods find the pattern on its base, and how soon is its class known?"""

from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np

from jaxnbv.checks import require
from jaxnbv.studies.classification.measures import HITS_EXPLAINED, charts_of, hits_and_diagnostics, seen_explained
from jaxnbv.studies.classification.study import ClassificationStudy, Truth
from jaxnbv.studies.engine.measures import Measure, Record
from jaxnbv.studies.engine.study import Chart, Scene
from jaxnbv.studies.scenes import CLASS_SETS, ClassSet, FirstView, Framing, Pyramid
from jaxnbv.studies.scenes.class_object import choose_hidden

# Of the cameras from which the pattern cannot be seen two fifths lie in each of the first two, a fifth in the last.
_ANGLES = {"under 110": (0.0, 110.0), "110-140": (110.0, 140.0), "140-180": (140.0, 180.1)}


class PyramidStudy(ClassificationStudy):
    """The class of a pyramid whose pattern the first view does not show. Settings as of `ClassificationStudy`."""

    title: ClassVar[str] = "The class of a pyramid"
    explanation: ClassVar[str] = (
        f"{HITS_EXPLAINED}{seen_explained('pattern')}\n"
        "Diagnostics are by the view being chosen, in ( ) their scenes. Angles are of the first view from the base's "
        "normal."
    )
    objects: ClassVar[ClassSet] = CLASS_SETS["pyramid"]
    cue: ClassVar[str] = "pattern"
    network: ClassVar[str] = "pyramid"
    framings: ClassVar[tuple[Framing, ...]] = tuple(Framing)
    solid: ClassVar[bool] = True
    bank: ClassVar[str] = "pyramid"
    measures: ClassVar[tuple[Measure, ...]] = hits_and_diagnostics(cue)
    charts: ClassVar[Mapping[str, Chart]] = charts_of(cue, "angles")
    seed: ClassVar[int] = 2

    @classmethod
    def groups(cls, records: Sequence[Record]) -> dict[str, list[Record]]:
        """All, and those in each bin of the first view's angle; no bin is empty."""
        bins = {name: [r for r in records if low <= r["angle"] < high] for name, (low, high) in _ANGLES.items()}
        return {"all": list(records)} | {f"first view at {name}°": of for name, of in bins.items() if of}

    def facts(self, scene: Scene, truth: Truth, first: int) -> Record:
        """With the first view's angle from the base's normal, in degrees: at 180 it looks from behind the apex."""
        direction = np.asarray(self.candidates.poses().position[first])
        # The base looks along -z of the pyramid's own frame.
        assert isinstance(truth.thing, Pyramid)
        outward = -np.asarray(truth.thing.rotation)[:, 2]
        cosine = np.clip(direction @ outward / np.linalg.norm(direction), -1.0, 1.0)
        return super().facts(scene, truth, first) | {"angle": float(np.degrees(np.arccos(cosine)))}

    def first_view(self, scene: Scene) -> int:
        """A random one of the candidates that do not show the pattern, but something, as `first` asks."""
        pixels, scans = scene.task.pixels, scene.task.scans
        if self.first is not FirstView.ANY:
            enough = [self.shows_enough(scene, scans[index]) for index in range(self.num_candidates)]
            require(
                any(enough),
                f"the classifier is right after all {self.num_candidates} candidates of {scene.name}: {self.remedy}",
            )
            pixels = np.where(enough, pixels, 1)
        return choose_hidden(pixels, scans, self.key(scene.index, "first"))
