"""What a task of the command line is. Nothing here loads JAX, nor does a task before it is chosen."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, NamedTuple

from jaxnbv.cli.options import asking

if TYPE_CHECKING:
    from jaxnbv.acquisition import Acquisition
    from jaxnbv.geometry.camera import Camera
    from jaxnbv.geometry.pose import Pose
    from jaxnbv.scanning import Grid, Surface, TriangleMesh
    from jaxnbv.scanning.sensors import Setting
    from jaxnbv.surfaces import ShapeBank

network_option = asking(
    metavar="FILE", help="A classifier, .pth or .safetensors, which tasks about the class need; for parts a segmenter."
)


class Subject(NamedTuple):
    """An object that an episode is played on.

    - `bank`: the shapes that are known of it, as in `--known`; or parts at the size that they have in the scene.
    - `grid`: of the imagined surfaces; None for the usual one.
    - `note`: what is said of it before the first view.
    """

    name: str
    surface: "Surface"
    acquisition: "Acquisition"
    first: "Pose"
    bank: "str | ShapeBank" = "none"
    grid: "Grid | None" = None
    note: str = ""


@dataclass(frozen=True, kw_only=True)
class Task(ABC):
    """A task of `jaxnbv run` and `jaxnbv demo`. Its fields are options of `run`, required where they have no default.

    - `name`: in `--task`; `about`: what is asked, a clause for the help.
    - `example`: the object of the demo, a clause for the help.
    - `until`: what is enough for the demo, as in `--until`; farthest view then races it.
    """

    name: ClassVar[str]
    about: ClassVar[str]
    example: ClassVar[str]
    until: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def setting(cls) -> "Setting":
        """The sensor."""
        from jaxnbv.scanning.sensors import USUAL_SETTING

        return USUAL_SETTING

    @abstractmethod
    def acquisition(self, mesh: "TriangleMesh", camera: "Camera", first: "Pose") -> "Acquisition":
        """What views of a user's mesh are chosen by; `first`: where the first view is taken."""

    def bank(self, mesh: "TriangleMesh") -> "str | ShapeBank":
        """The shapes that are known of a user's mesh, as of a `Subject`."""
        return "none"

    @classmethod
    @abstractmethod
    def demo(cls, scene: int, seed: int) -> Subject:
        """One of the objects that ship, by the numbers of a scene and of a seed."""


def usual_first(radius: float | None = None) -> "Pose":
    """The pose of a first view by default: from the usual side, this far away (scene units)."""
    from jaxnbv.geometry.pose import look_at

    usual = (0.8, 0.9, 2.2)
    scale = 1.0 if radius is None else radius / math.hypot(*usual)
    return look_at(tuple(scale * x for x in usual))
