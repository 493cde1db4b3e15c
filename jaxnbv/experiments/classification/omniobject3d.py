"""Fruits that are told by what is small on them: the experiment of the paper's supplement."""

from collections.abc import Mapping
from typing import ClassVar

from jaxnbv.datasets import CLASS_SETS, ClassSet
from jaxnbv.experiments.classification.measures import HITS_EXPLAINED, ROUGHNESS, diagnostics_chart, hits
from jaxnbv.experiments.classification.study import ClassificationStudy
from jaxnbv.experiments.measures import Measure
from jaxnbv.experiments.study import Chart, Panel


class OmniObject3DStudy(ClassificationStudy):
    """The class of a fruit, from a random first view. Settings as of `ClassificationStudy`."""

    title: ClassVar[str] = "The class of a fruit"
    explanation: ClassVar[str] = f"{HITS_EXPLAINED}Roughness is by the view being chosen, in ( ) its scenes."
    objects: ClassVar[ClassSet] = CLASS_SETS["fruit"]
    telling: ClassVar[str] = ""
    network: ClassVar[str] = "fruit"
    fed: ClassVar[tuple[int, int]] = (1024, 512)
    solid: ClassVar[bool] = True
    measures: ClassVar[tuple[Measure, ...]] = (*hits(), ROUGHNESS)
    charts: ClassVar[Mapping[str, Chart]] = {
        "hits": Chart((tuple(map(Panel, ("first", "stable"))),)),
        "diagnostics": diagnostics_chart("roughness"),
    }
    seed: ClassVar[int] = 14
