"""What the commands hand on to what they do: plain values of their options."""

from enum import StrEnum
from pathlib import Path
from typing import Any, NamedTuple

DEFAULT_FIRST = "0.8,0.9,2.2"


class Device(StrEnum):
    """Where the computation runs."""

    AUTO = "auto"
    CPU = "cpu"
    GPU = "gpu"


class EpisodeOptions(NamedTuple):
    """What every command that runs one episode takes.

    - `asked`: all of its options that a view depends on, by name.
    """

    search: str
    model: str
    known: str | None
    views: int
    until: list[str] | None
    seed: int
    out: Path | None
    overwrite: bool
    noise: float
    quick: bool
    report: bool
    asked: dict[str, Any]


class SensorOptions(NamedTuple):
    """The sensor of `jaxnbv run`; None leaves what fits the object.

    - `fov`: degrees; `radius`: scene units; `rays`: along a side.
    """

    paper: bool = False
    fov: float | None = None
    radius: float | None = None
    rays: int | None = None


class SizeOptions(NamedTuple):
    """How much is imagined; None leaves the usual number."""

    samples: int | None = None
    candidates: int | None = None
    lengthscale: float | None = None


USUAL_SIZE = SizeOptions()
