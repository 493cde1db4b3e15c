"""The paper's sanity check: ten classes that are told by their global shape, for which any views will do."""

from typing import ClassVar

from jaxnbv.datasets import CLASS_SETS, ClassSet
from jaxnbv.experiments.classification.study import ClassificationStudy


class ModelNet10Study(ClassificationStudy):
    """The class of a household object, from a random first view. Settings as of `ClassificationStudy`."""

    title: ClassVar[str] = "The class of a household object"
    objects: ClassVar[ClassSet] = CLASS_SETS["household"]
    network: ClassVar[str] = "household"
    seed: ClassVar[int] = 12
