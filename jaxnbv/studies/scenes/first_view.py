"""From where an object is seen first."""

from enum import StrEnum


class FirstView(StrEnum):
    """Which views of an object may be the first one: any, or those after which the classifier is wrong."""

    ANY = "any"
    MISCLASSIFIED = "misclassified"
