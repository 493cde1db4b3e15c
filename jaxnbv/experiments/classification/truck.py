"""The study of the loaded truck: its outside is most of what can be seen, and says nothing of the cargo's class."""

from collections.abc import Mapping
from typing import ClassVar

import equinox as eqx

from jaxnbv.datasets import CLASS_SETS, ClassSet
from jaxnbv.experiments.classification.measures import (
    HITS_EXPLAINED,
    ROUGHNESS,
    diagnostic,
    diagnostics_chart,
    hits,
    seen_explained,
)
from jaxnbv.experiments.classification.study import ClassificationStudy
from jaxnbv.experiments.measures import Measure
from jaxnbv.experiments.study import Chart, Panel


class TruckStudy(ClassificationStudy):
    """The class of a truck's cargo, from a random first view. Settings as of `ClassificationStudy`."""

    title: ClassVar[str] = "The class of a truck's cargo"
    explanation: ClassVar[str] = (
        f"{HITS_EXPLAINED}{seen_explained('cargo')}\nDiagnostics are by the view being chosen, in ( ) their scenes."
    )
    objects: ClassVar[ClassSet] = CLASS_SETS["truck"]
    telling: ClassVar[str] = "cargo"
    network: ClassVar[str] = "truck"
    fed: ClassVar[tuple[int, int]] = (2048, 1024)
    measures: ClassVar[tuple[Measure, ...]] = (
        *hits(telling),
        diagnostic("rank_correlation", "Rank correlation"),
        ROUGHNESS,
    )
    charts: ClassVar[Mapping[str, Chart]] = {
        "hits": Chart((tuple(map(Panel, ("first", "stable", "cargo"))),)),
        "first_views": Chart((tuple(map(Panel, ("first", "stable", "cargo"))),), by_group=True),
        "diagnostics": diagnostics_chart("rank_correlation", "roughness"),
    }
    seed: ClassVar[int] = 11

    num_points: int = eqx.field(static=True, default=1024)
