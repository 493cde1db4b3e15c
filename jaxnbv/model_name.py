"""The names of `jaxnbv.presets`."""

from enum import StrEnum


class ModelName(StrEnum):
    """By what surfaces are imagined."""

    SCREENED = "screened"
    PAPER = "paper"
