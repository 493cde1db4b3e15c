"""Base classes of utilities and of a task's answers, and the name and unit of what a search maximises."""

from abc import abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeAlias

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from jaxnbv.checks import require, short_text
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.frame import Frame
from jaxnbv.scanning import Surface
from jaxnbv.sharding import on_cpu

_POWERS = {1: "", 2: "²", 3: "³"}


class Quantity(eqx.Module):
    """Name, unit and meaning of the values that a search maximises, for tables and captions.

    - `name`, `unit`: in words. `unit` leaves out length, see `length_power`, and may be empty.
    - `meaning`: the rest of a caption that begins with "Value:".
    - `smooth`: whether interpolation between the values of two candidates makes sense.
    - `length_power`: power of length in the unit (2 for an area).
    """

    name: str
    unit: str
    meaning: str
    smooth: bool = True
    length_power: int = 0

    def unit_in(self, frame: Frame) -> str:
        """Return the whole unit in words, with lengths in the unit of the frame's world."""
        length = f"{frame.unit}{_POWERS.get(self.length_power, f'^{self.length_power}')}" if self.length_power else ""
        return f"{length} {self.unit}".strip()


class Answer(eqx.Module):
    """The answer to a task's question, given a cloud: named numbers. `jaxnbv.viz` puts them into words.

    - `form`: format of a value, for `str.format`.
    """

    names: tuple[str, ...]
    values: Float[np.ndarray, " n"]
    form: str = "{:.4g}"

    def in_world(self, frame: Frame) -> "Answer":
        """Return a copy with points and lengths, if any, in the frame's world."""
        return self


def default_batch_size() -> int:
    """Return the number of clouds to evaluate together: 128, or 1 on a CPU because of its smaller cache."""
    return 1 if on_cpu() else 128


class Utility(eqx.Module):
    """Base class of utilities u(D), which give the value of a cloud D as one number.

    Subclasses need to define only `__call__`.

    - `name`: name of the utility in words.
    - `improvement`: name, unit and meaning of the expected improvement by a view.
    """

    @abstractmethod
    def __call__(self, cloud: PointCloud) -> Float[Array, ""]:
        """Compute the utility of a cloud by JAX operations. Rows whose mask is False must be left out."""

    @property
    def name(self) -> str:
        return "utility"

    @property
    def improvement(self) -> Quantity:
        meaning = "how much an imagined scan raises the utility of the cloud, mean over posterior samples."
        name = "utility improvement" if self.name == "utility" else f"improvement of {self.name}"
        return Quantity(f"expected {name}", "", meaning)

    @property
    def batch_size(self) -> int:
        """Number of clouds to evaluate together."""
        return default_batch_size()

    def answer(self, cloud: PointCloud) -> Answer | None:
        """Return the answer to the task's question, given a cloud; None if the cloud's utility is the answer."""
        return None

    def answer_values(self, cloud: PointCloud) -> Float[Array, " n"] | None:
        """Return `answer(cloud).values`, computed by JAX; None if there is no answer or JAX cannot compute it."""
        return None

    def true_answer(self, scene: Surface, cloud: PointCloud) -> Answer | None:
        """Return the correct answer for the true surface `scene`.

        None means that `answer(cloud)`, computed from points on the whole surface, is taken as the correct answer.
        """
        return None

    def check(self, cloud: PointCloud) -> None:
        """Raise `ValueError` if the utility's network or function returns an invalid result for a cloud."""
        return


class FunctionUtility(Utility):
    """A utility that calls a plain function of a cloud. The utility is named after the function."""

    function: Callable[[PointCloud], Float[Array, ""]]

    # `ExpectedUtilityImprovement` checks the result, because it can name the utility in the error.
    def __call__(self, cloud: PointCloud) -> Any:
        return self.function(cloud)

    @property
    def name(self) -> str:
        # Only functions have a `__name__`. Other callable objects do not.
        name = getattr(self.function, "__name__", "").strip("_").replace("_", " ")
        return name if name and name != "<lambda>" else "utility"


def plain_function(value: Any, name: str, example: str = "") -> Callable[..., Any]:
    """Check that the value of the argument called `name` is a function, and return the value.

    **Raises:** `ValueError` for anything else, including a class. The message contains the text `example`.
    """
    is_function = callable(value) and not isinstance(value, type)
    require(is_function, f"{name} is {short_text(value)}: give one{example}, or a function of a cloud")
    return value


def as_utility(value: Any) -> Utility:
    """Return a utility unchanged, or a plain function wrapped as a utility.

    **Raises:** `ValueError` for anything else.
    """
    return value if isinstance(value, Utility) else FunctionUtility(plain_function(value, "the utility"))


# Fields of this type have a converter for plain functions. mypy does not know about converters.
if TYPE_CHECKING:
    AnyUtility: TypeAlias = Any
else:
    AnyUtility = Utility
