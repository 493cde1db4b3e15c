"""Options of studies for the size and position of an object and for its first view.

This module does not import JAX, because the command line imports it for its help.
"""

from enum import StrEnum


class Framing(StrEnum):
    """Size of the object relative to the camera's field of view.

    A view shows a patch of the object (`CLOSE_UP`) or nearly all of the side that faces the camera (`WHOLE`).
    """

    CLOSE_UP = "close-up"
    WHOLE = "whole"

    @property
    def longest_side(self) -> float:
        """Longest side of the object's bounding box, in scene units."""
        return 2.5 if self is Framing.CLOSE_UP else 1.25


class FirstView(StrEnum):
    """Condition for the first view of an object: `ANY` view, or one after which the classifier is wrong."""

    ANY = "any"
    MISCLASSIFIED = "misclassified"


class Setup(StrEnum):
    """Setup in which a known part is scanned.

    - `WHOLE`: a view shows nearly all of the side of the part that faces the camera.
    - `CLOSE_UP`: a view shows a patch of the part.
    - `TABLE`: the part rests on a table.
    - `HIDDEN`: the part rests on a table, beside a box that hides half of one side.
    """

    WHOLE = "whole"
    CLOSE_UP = "close-up"
    TABLE = "table"
    HIDDEN = "hidden"

    @property
    def radius(self) -> float:
        """Distance of the cameras from the part's centre, in scene units. The part's longest side is 2.5."""
        return 2.2 if self is Setup.CLOSE_UP else 5.0

    @property
    def is_resting(self) -> bool:
        """Whether the part rests on a table."""
        return self in (Setup.TABLE, Setup.HIDDEN)
