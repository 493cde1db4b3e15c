"""Fruits that are told by what is small on them: the experiment of the paper's supplement."""

from typing import ClassVar

from jaxnbv.studies.classification.study import ClassificationStudy
from jaxnbv.studies.scenes import CLASS_SETS, ClassSet


class OmniObject3DStudy(ClassificationStudy):
    """The class of a fruit, from a random first view. Settings as of `ClassificationStudy`."""

    title: ClassVar[str] = "The class of a fruit"
    objects: ClassVar[ClassSet] = CLASS_SETS["fruit"]
    network: ClassVar[str] = "fruit"
    bank: ClassVar[str] = "fruit"
    solid: ClassVar[bool] = True
    seed: ClassVar[int] = 14
