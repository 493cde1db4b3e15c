"""Recipes that make the shipped banks of procedural shapes from scenes of the training split."""

from collections.abc import Callable
from typing import Any, NamedTuple

from jaxnbv.scanning.sdf import SignedDistance
from jaxnbv.studies.scenes.heat_objects import FIRST_TRAINING, HEAT_OBJECTS, heat_scene
from jaxnbv.studies.scenes.household import HOUSEHOLD, household_scene
from jaxnbv.studies.scenes.part_scenes import PART_CATEGORIES, part_scene
from jaxnbv.studies.scenes.pyramid import PATTERNS, pyramid_scene
from jaxnbv.studies.scenes.splits import Split
from jaxnbv.studies.scenes.truck import truck_scene
from jaxnbv.surfaces import ShapeBank


class BankRecipe(NamedTuple):
    """Defines the shapes of a bank of known shapes.

    - `number`: number of shapes; `kinds`: names of their kinds. Shape i is of kind `kinds[i % len(kinds)]`.
    - `shape`: function from i to shape i, without a random rotation.
    """

    number: int
    kinds: tuple[str, ...]
    shape: Callable[[int], SignedDistance]

    def make(self) -> ShapeBank:
        """Make the bank. A shape's name is its kind and its index."""
        names = [f"{self.kinds[index % len(self.kinds)]} {index}" for index in range(self.number)]
        return ShapeBank.of([self.shape(index) for index in range(self.number)], names)


def _heat_solid(index: int) -> SignedDistance:
    surface: Any = heat_scene(FIRST_TRAINING + index, is_rotated=False).surface
    return surface.sdf


RECIPES = {
    "pyramid": BankRecipe(1024, PATTERNS, lambda i: pyramid_scene(Split.TRAIN, i, is_rotated=False).solid),
    "truck": BankRecipe(512, HOUSEHOLD, lambda i: truck_scene(Split.TRAIN, i, is_rotated=False).solid),
    "household": BankRecipe(512, HOUSEHOLD, lambda i: household_scene(Split.TRAIN, i, is_rotated=False).solid),
    "parts": BankRecipe(520, PART_CATEGORIES, lambda i: part_scene(Split.TRAIN, i).solid),
    "heat": BankRecipe(256, HEAT_OBJECTS, _heat_solid),
}
"""Recipes of the shipped banks by name."""
