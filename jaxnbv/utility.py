"""What a cloud is worth, in numbers and in words: utilities, answers, and the quantities that are maximised."""

from abc import abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeAlias

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from jaxnbv.checks import require, shown
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.frame import Frame
from jaxnbv.scanning import Surface
from jaxnbv.sharding import on_cpu

_POWERS = {1: "", 2: "²", 3: "³"}


class Quantity(eqx.Module):
    """The name, unit and meaning of what is maximised, for tables and captions.

    - `name`, `unit`: in words; the unit is empty where there is none, and leaves out the power of length.
    - `meaning`: the rest of a caption that begins with "Value:".
    - `smooth`: whether values between two candidates mean anything.
    - `length_power`: power of length in the unit (2 for an area).
    """

    name: str
    unit: str
    meaning: str
    smooth: bool = True
    length_power: int = 0

    def unit_in(self, frame: Frame) -> str:
        """The whole unit in words, lengths in the units of a frame's world."""
        length = f"{frame.unit}{_POWERS.get(self.length_power, f'^{self.length_power}')}" if self.length_power else ""
        return f"{length} {self.unit}".strip()


class Answer(eqx.Module):
    """What the cloud D answers to the question: numbers with names. `jaxnbv.viz` puts them into words.

    - `names`, `values`: one each.
    - `form`: how a value is written, in the language of `str.format`.
    """

    names: tuple[str, ...]
    values: Float[np.ndarray, " n"]
    form: str = "{:.4g}"

    def in_world(self, frame: Frame) -> "Answer":
        """The answer, to be said in the world of a frame: the same, unless it has points or lengths."""
        return self


def default_batch_size() -> int:
    """How many calls of a function of clouds to batch.

    A CPU takes them one by one, lest a network's layers leave its cache, and a GPU many at once.
    """
    return 1 if on_cpu() else 128


class Utility(eqx.Module):
    """u(D): one number that says what a cloud is worth. Only `__call__` must be given.

    `name` is in words. `improvement` is the `Quantity` that is expected of a view.
    """

    @abstractmethod
    def __call__(self, cloud: PointCloud) -> Float[Array, ""]:
        """u(D) of a cloud (rows, masked), made of JAX operations."""

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
        """How many clouds are valued together."""
        return default_batch_size()

    def answer(self, cloud: PointCloud) -> Answer | None:
        """What D answers; None for u(D) itself."""
        return None

    def answer_values(self, cloud: PointCloud) -> Float[Array, " n"] | None:
        """See `Acquisition.answer_values`."""
        return None

    def true_answer(self, scene: Surface, cloud: PointCloud) -> Answer | None:
        """What `answer` should come to, see `Acquisition.true_answer`; None for `answer` on all of the surface."""
        return None

    def check(self, cloud: PointCloud) -> None:
        """Raise `ValueError` if what the utility is made of gives something impossible on a cloud."""
        return


class FunctionUtility(Utility):
    """A plain function of a cloud as a utility, which has the function's name."""

    function: Callable[[PointCloud], Float[Array, ""]]

    # What it returns is checked by `Acquisition.check`, which names it.
    def __call__(self, cloud: PointCloud) -> Any:
        return self.function(cloud)

    @property
    def name(self) -> str:
        # Only functions have a name of their own; a callable object does not.
        name = getattr(self.function, "__name__", "").strip("_").replace("_", " ")
        return name if name and name != "<lambda>" else "utility"


def plain_function(value: Any, name: str, example: str = "") -> Callable[..., Any]:
    """A function of a cloud as it is.

    **Raises:** `ValueError` for anything else, a class included.
    """
    proper = callable(value) and not isinstance(value, type)
    require(proper, f"{name} is {shown(value)}: give one{example}, or a function of a cloud")
    return value


def as_utility(value: Any) -> Utility:
    """A utility as it is; a plain function as one.

    **Raises:** `ValueError` for anything else.
    """
    return value if isinstance(value, Utility) else FunctionUtility(plain_function(value, "the utility"))


# Functions are converted on the way in, which mypy cannot see.
if TYPE_CHECKING:
    AnyUtility: TypeAlias = Any
else:
    AnyUtility = Utility
