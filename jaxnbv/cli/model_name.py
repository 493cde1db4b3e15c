"""The names of `jaxnbv.imagination`."""

from enum import StrEnum


class ModelName(StrEnum):
    """By what surfaces are imagined."""

    SCREENED = "screened"
    PAPER = "paper"
