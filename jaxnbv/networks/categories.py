"""Categories and parts of ShapeNet-part (Yi et al. 2016), in the order of the published networks.

The data set only numbers its fifty parts. The names of the parts are our own.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from jaxnbv.checks import require


class Category(NamedTuple):
    """A category of objects, and its parts.

    - `synset`: name of the category's folder in the data set.
    - `first_label`: label of the first part. The labels of a category's parts are consecutive.
    """

    name: str
    synset: str
    parts: tuple[str, ...]
    first_label: int

    @property
    def labels(self) -> range:
        """The labels of the parts, one for each name in `parts`."""
        return range(self.first_label, self.first_label + len(self.parts))


CATEGORIES = (
    Category("airplane", "02691156", ("body", "wing", "tail", "engine"), 0),
    Category("bag", "02773838", ("handle", "body"), 4),
    Category("cap", "02954340", ("crown", "brim"), 6),
    Category("car", "02958343", ("roof", "hood", "wheel", "body"), 8),
    Category("chair", "03001627", ("back", "seat", "leg", "arm"), 12),
    Category("earphone", "03261776", ("ear cup", "headband", "wire"), 16),
    Category("guitar", "03467517", ("head", "neck", "body"), 19),
    Category("knife", "03624134", ("blade", "handle"), 22),
    Category("lamp", "03636649", ("base", "shade", "canopy", "tube"), 24),
    Category("laptop", "03642806", ("keyboard", "screen"), 28),
    Category("motorbike", "03790512", ("gas tank", "seat", "wheel", "handles", "light", "frame"), 30),
    Category("mug", "03797390", ("handle", "body"), 36),
    Category("pistol", "03948459", ("barrel", "handle", "trigger"), 38),
    Category("rocket", "04099429", ("body", "fin", "nose"), 41),
    Category("skateboard", "04225987", ("wheel", "deck", "truck"), 44),
    Category("table", "04379243", ("top", "leg", "drawer"), 47),
)
NUM_PARTS = 50


def category_index(name: str) -> int:
    """Return the index in `CATEGORIES` of the category with this name. Networks use the same index.

    **Raises:** `ValueError` for an unknown name.
    """
    names = [category.name for category in CATEGORIES]
    require(name.lower() in names, f"there is no category '{name}' in ShapeNet-part: choose from {', '.join(names)}")
    return names.index(name.lower())


def part_mask() -> Bool[np.ndarray, "categories parts"]:
    """Return a mask that is True where the part (axis 1) belongs to the category (axis 0)."""
    return np.array([[label in category.labels for label in range(NUM_PARTS)] for category in CATEGORIES])
