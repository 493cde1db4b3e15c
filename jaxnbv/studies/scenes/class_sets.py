"""The procedural scenes whose class is asked for, by name."""

from collections.abc import Callable
from typing import NamedTuple

from jaxnbv.studies.scenes.class_object import ClassObject
from jaxnbv.studies.scenes.household import HOUSEHOLD, household_scene
from jaxnbv.studies.scenes.patterns import PATTERNS
from jaxnbv.studies.scenes.pyramid import pyramid_scene
from jaxnbv.studies.scenes.truck import truck_scene


class ClassSet(NamedTuple):
    """Scenes of several classes.

    - `classes`: their names.
    - `scene`: of a split, an index and a framing; None where meshes alone are such scenes.
    """

    classes: tuple[str, ...]
    scene: Callable[..., ClassObject] | None = None


CLASS_SETS = {
    "pyramid": ClassSet(PATTERNS, pyramid_scene),
    "truck": ClassSet(HOUSEHOLD, truck_scene),
    "household": ClassSet(HOUSEHOLD, household_scene),
}
