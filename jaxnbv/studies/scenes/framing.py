"""How much of an object a view shows."""

from enum import StrEnum


class Framing(StrEnum):
    """How large the object stands before the sensor: a view shows a patch, or nearly all of its near side."""

    CLOSE_UP = "close-up"
    WHOLE = "whole"

    @property
    def longest_side(self) -> float:
        """Longest side of the object's box in scene units."""
        return 2.5 if self is Framing.CLOSE_UP else 1.25
