"""The paper's sanity check: ten classes that are told by their global shape, for which any views will do."""

from typing import ClassVar

from jaxnbv.studies.classification.study import BASELINES, ClassificationStudy
from jaxnbv.studies.engine.measures import Claim
from jaxnbv.studies.scenes import CLASS_SETS, ClassSet


class ModelNet10Study(ClassificationStudy):
    """The class of a household object, from a random first view. Settings as of `ClassificationStudy`."""

    title: ClassVar[str] = "The class of a household object"
    objects: ClassVar[ClassSet] = CLASS_SETS["household"]
    network: ClassVar[str] = "household"
    bank: ClassVar[str] = "household"
    seed: ClassVar[int] = 12
    claims: ClassVar[tuple[Claim, ...]] = (
        Claim("Where global features tell the class, cross-entropy is as good.", "first", 2, BASELINES, ahead=False),
    )
