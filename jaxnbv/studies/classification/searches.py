"""The study of searches: does a search by gradient find better views than one over candidates, and what does it cost?

The paper's comparison of its two ways to maximise the acquisition, over candidates and by gradient, on pyramids and on
trucks; and successive halving, constrained 6-DOF poses, and gradient ascent from the best candidates beside them.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar

import equinox as eqx
import numpy as np

from jaxnbv.planning.episode import Step
from jaxnbv.planning.planner import Planner
from jaxnbv.search import (
    ConstrainedPoses,
    GradientSearch,
    HalvingSearch,
    HybridSearch,
    PoseSpace,
    Search,
    SpherePoses,
)
from jaxnbv.studies.classification.measures import hits, seen_explained
from jaxnbv.studies.classification.objects import PyramidStudy, TruckStudy
from jaxnbv.studies.classification.study import ClassificationStudy, Truth
from jaxnbv.studies.engine.measures import Claim, Measure, Record
from jaxnbv.studies.engine.study import Chart, Panel, Scene, Study
from jaxnbv.tasks import CrossEntropy

_SPACES: dict[str, type[PoseSpace]] = {"gradient-2dof": SpherePoses, "gradient-constrained": ConstrainedPoses}


def _value(record: Record, method: str) -> list[float]:
    return record["methods"][method]["values"]


def _seconds(record: Record, method: str) -> list[float]:
    """The median over a scene's steps but the first, which may have compiled."""
    seconds = record["methods"][method]["seconds"]
    return [float(np.median(seconds[1:]))] if len(seconds) > 1 else [np.nan]


class _Searches(ClassificationStudy):
    """The class of an object by cross-entropy, whose view is sought in several ways. Settings as of
    `ClassificationStudy`, and

    - `num_starts`, `iterations`, `learning_rate`: of the gradient searches, which look at half the candidates first.

    Free 6-DOF poses are left out as in the paper, where they drift to views that miss the object; `ConstrainedPoses`
    keep it in view.
    """

    title: ClassVar[str] = "Ways to maximise the expected cross-entropy"
    searches_explained: ClassVar[str] = (
        "First hit: a right prediction so far. Stable hit: right from then to the end. All searches start from the\n"
        "same view and see the same noise and, at view 2, the same samples, so that there the values that they found\n"
        "can be compared. Seconds are of a proposal once it is compiled, the median over the steps of a scene.\n"
    )
    methods: ClassVar[tuple[str, ...]] = ("discrete", "halving", *_SPACES, "hybrid")
    unknowing: ClassVar[tuple[str, ...]] = ()
    reference: ClassVar[str] = "discrete"
    claims: ClassVar[tuple[Claim, ...]] = (
        Claim(
            "Search over candidates tells the class as soon as search by gradient, or almost.",
            "stable",
            2,
            tuple(_SPACES),
            ahead=False,
        ),
    )
    own_measures: ClassVar[tuple[Measure, ...]] = (
        Measure("value", "Expected cross-entropy of the view", _value, first=2, unit="nats", better="more"),
        Measure("seconds", "Time of a proposal", _seconds, ("median",), "step", unit="seconds", better="less"),
    )
    charts: ClassVar[Mapping[str, Chart]] = {
        "searches": Chart(((Panel("stable"), Panel("value", "Expected cross-entropy"), Panel("seconds")),)),
    }
    quick: ClassVar[Mapping[str, Any]] = {**ClassificationStudy.quick, "num_starts": 2, "iterations": 3}

    num_starts: int = eqx.field(static=True, default=4)
    iterations: int = eqx.field(static=True, default=8)
    learning_rate: float = eqx.field(static=True, default=0.03)

    def planner(self, method: str, scene: Scene) -> Planner:
        acquisition = CrossEntropy(self.imagining or self.classifier, self.num_points)
        return self.planner_of(acquisition, self.search(method), scene)

    def search(self, method: str) -> Search:
        if method in _SPACES:
            candidates = max(self.num_candidates // 2, self.num_starts)
            steps = self.num_starts, self.iterations, self.learning_rate
            return GradientSearch(None, _SPACES[method](), *steps, num_candidates=candidates)
        if method == "halving":
            return HalvingSearch(self.candidates)
        return HybridSearch(candidates=self.candidates) if method == "hybrid" else super().search(method)

    def run_methods(self, scene: Scene, truth: Truth, first: int, methods: Sequence[str]) -> dict[str, Record]:
        """One by one, since each search chooses its own poses."""
        return Study.run_methods(self, scene, truth, first, methods)

    def follow(
        self, scene: Scene, truth: Truth, method: str, methods: Sequence[str], episode: Iterator[Step]
    ) -> Record:
        """As of `ClassificationStudy`, and of each view that was sought its value and the seconds that it took."""
        values, seconds = [], []

        def noted() -> Iterator[Step]:
            for step in episode:
                if step.view.proposal is not None:
                    values.append(float(step.view.proposal.value))
                    seconds.append(step.seconds)
                yield step

        return super().follow(scene, truth, method, methods, noted()) | {"values": values, "seconds": seconds}


class TruckSearchStudy(_Searches, TruckStudy):
    """On trucks."""

    explanation: ClassVar[str] = f"{_Searches.searches_explained}{seen_explained('cargo')}"
    measures: ClassVar[tuple[Measure, ...]] = (*hits("cargo"), *_Searches.own_measures)
    seed: ClassVar[int] = 13


class SearchStudy(_Searches, PyramidStudy):
    """On pyramids."""

    explanation: ClassVar[str] = f"{_Searches.searches_explained}{seen_explained('pattern')}"
    measures: ClassVar[tuple[Measure, ...]] = (*hits("pattern"), *_Searches.own_measures)
    seed: ClassVar[int] = 10

    @classmethod
    def configured(cls, model: str, views: int, quick: bool, **options: Any) -> dict[str, Study]:
        """On pyramids of each framing, and on trucks, if none is given."""
        pyramids = super().configured(model, views, quick, **options)
        if "framing" in options:
            return pyramids
        (truck,) = TruckSearchStudy.configured(model, views, quick, **options).values()
        return pyramids | {"truck": truck}
