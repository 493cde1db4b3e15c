"""Base class of the command line's tasks. Only their methods import JAX, so that the help appears at once."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import jaxnbv as nbv
from jaxnbv.cli.options import task_option

if TYPE_CHECKING:
    from jaxnbv.scanning.sensors import Setting

network_option = task_option(
    metavar="FILE", help="Network, .pth or .safetensors: a classifier for tasks about the class, a segmenter for parts."
)


class Subject(NamedTuple):
    """The object of an episode, with its acquisition and first pose.

    - `bank`: known shapes as in `--known`, or a bank of parts with sizes in scene units.
    - `grid`, `question`: grid of the imagined surfaces, and question at the head of the report. None for the default.
    - `note`: text to print before the first view.
    """

    name: str
    surface: "nbv.scanning.Surface"
    acquisition: "nbv.Acquisition"
    first: "nbv.Pose"
    bank: "str | nbv.ShapeBank" = "none"
    grid: "nbv.Grid | None" = None
    note: str = ""
    question: str | None = None


@dataclass(frozen=True, kw_only=True)
class Task(ABC):
    """A task of `jaxnbv run` and `jaxnbv demo`.

    The fields of a task are options of `run`, required if they have no default.

    - `about`: the question of the task, as a phrase for the help.
    - `example`: the object of the demo, as a phrase for the help.
    - `until`: default of `--until` in the demo. If it is not empty, the demo also runs farthest view for comparison.
    """

    name: ClassVar[str]
    about: ClassVar[str]
    example: ClassVar[str]
    until: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def setting(cls) -> "Setting":
        """Return the camera, the candidates' distance from the origin, and the number of candidates."""
        from jaxnbv.scanning.sensors import USUAL_SETTING

        return USUAL_SETTING

    @abstractmethod
    def acquisition(self, mesh: "nbv.TriangleMesh", camera: "nbv.Camera", first: "nbv.Pose") -> "nbv.Acquisition":
        """Make the acquisition for views of a user's mesh. `first` is the pose of the first view."""

    def bank(self, mesh: "nbv.TriangleMesh") -> "str | nbv.ShapeBank":
        """Return the known shapes for a user's mesh: a name as in `--known`, or parts in scene units."""
        return "none"

    @classmethod
    @abstractmethod
    def demo(cls, scene: int, seed: int) -> Subject:
        """Return object number `scene` of the demo. `seed` decides its first view."""


def default_first_pose(radius: float | None = None) -> "nbv.Pose":
    """Return the default first pose: at (0.8, 0.9, 2.2), or in this direction at distance `radius`."""
    direction = (0.8, 0.9, 2.2)
    scale = 1.0 if radius is None else radius / math.hypot(*direction)
    return nbv.look_at(tuple(scale * x for x in direction))
