"""How large an object stands, and from where it is seen first. Commands offer both: nothing heavy is imported."""

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
