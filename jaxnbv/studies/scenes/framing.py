"""How large an object stands, where, and from where it is seen first.

Commands offer these: nothing heavy is imported.
"""

from enum import StrEnum


class Framing(StrEnum):
    """How large the object stands before the sensor: a view shows a patch, or nearly all of its near side."""

    CLOSE_UP = "close-up"
    WHOLE = "whole"

    @property
    def longest_side(self) -> float:
        """Longest side of the object's box in scene units."""
        return 2.5 if self is Framing.CLOSE_UP else 1.25


class FirstView(StrEnum):
    """Which views of an object may be the first one: any, or those after which the classifier is wrong."""

    ANY = "any"
    MISCLASSIFIED = "misclassified"


class Setup(StrEnum):
    """How a known part is scanned: nearly all of its near side in view, a patch of it, resting on a table, or there
    beside a box that hides half of it."""

    WHOLE = "whole"
    CLOSE_UP = "close-up"
    TABLE = "table"
    HIDDEN = "hidden"

    @property
    def radius(self) -> float:
        """Distance of the cameras from the part's centre, in scene units, where its longest side is 2.5."""
        return 2.2 if self is Setup.CLOSE_UP else 5.0

    @property
    def is_resting(self) -> bool:
        """Whether the part lies on a table."""
        return self in (Setup.TABLE, Setup.HIDDEN)
