"""Options for the size and place of an object and for its first view.

Commands offer these options, so this module does not import JAX.
"""

from enum import StrEnum


class Framing(StrEnum):
    """Size of the object: a view shows a patch of it (close-up) or nearly all of its near side (whole)."""

    CLOSE_UP = "close-up"
    WHOLE = "whole"

    @property
    def longest_side(self) -> float:
        """Longest side of the object's bounding box, in scene units."""
        return 2.5 if self is Framing.CLOSE_UP else 1.25


class FirstView(StrEnum):
    """Allowed first views of an object: any, or only views after which the classifier is wrong."""

    ANY = "any"
    MISCLASSIFIED = "misclassified"


class Setup(StrEnum):
    """Setup in which a known part is scanned.

    A view shows nearly all of the part's near side (whole) or a patch of it (close-up), the part rests on a table
    (table), or it rests there beside a box that hides half of it (hidden).
    """

    WHOLE = "whole"
    CLOSE_UP = "close-up"
    TABLE = "table"
    HIDDEN = "hidden"

    @property
    def radius(self) -> float:
        """Distance of the cameras from the part's centre, in scene units (longest side 2.5)."""
        return 2.2 if self is Setup.CLOSE_UP else 5.0

    @property
    def is_resting(self) -> bool:
        """Whether the part rests on a table."""
        return self in (Setup.TABLE, Setup.HIDDEN)
