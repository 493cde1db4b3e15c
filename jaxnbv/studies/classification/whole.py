"""Objects all of which tells their class: the paper's sanity check, and the experiment of its supplement."""

from typing import ClassVar

from jaxnbv.studies.classification.study import BASELINES, ClassificationStudy
from jaxnbv.studies.engine.measures import Claim
from jaxnbv.studies.scenes import CLASS_SETS, ClassSet


class ModelNet10Study(ClassificationStudy):
    """The class of a household object, one of ten that are told by their global shape, for which any views will do;
    from a random first view. Settings as of `ClassificationStudy`."""

    title: ClassVar[str] = "The class of a household object"
    objects: ClassVar[ClassSet] = CLASS_SETS["household"]
    network: ClassVar[str] = "household"
    bank: ClassVar[str] = "household"
    seed: ClassVar[int] = 12
    claims: ClassVar[tuple[Claim, ...]] = (
        Claim("Where global features tell the class, cross-entropy is as good.", "first", 2, BASELINES, ahead=False),
    )


class OmniObject3DStudy(ClassificationStudy):
    """The class of a fruit, which is told by what is small on it, from a random first view. Settings as of
    `ClassificationStudy`."""

    title: ClassVar[str] = "The class of a fruit"
    objects: ClassVar[ClassSet] = CLASS_SETS["fruit"]
    network: ClassVar[str] = "fruit"
    bank: ClassVar[str] = "fruit"
    solid: ClassVar[bool] = True
    seed: ClassVar[int] = 14
