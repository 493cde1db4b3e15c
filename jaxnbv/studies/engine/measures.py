"""What a study measures: numbers of a record, by method and by view (or whatever else they are told by)."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

# What is stored of one scene with every method.
Record = dict[str, Any]
# The model of studies that know shapes, and the end of the name of a method that is run once more without them.
KNOWN, WITHOUT_BANK = "known", "-screened"


class Measure(NamedTuple):
    """One quantity of a study: a table, and a panel of its chart.

    - `name`: in files; `title`: in words.
    - `of`: its values in a record with a method, by view from the first on, or by whatever a mapping's keys are; None
      or NaN where it is not defined.
    - `by`: what the keys are.
    - `unit`: of the values; those in "%" are shares, in [0, 1].
    - `less`: whether less is better.
    """

    name: str
    title: str
    of: Callable[[Record, str], Sequence[float | None] | Float[np.ndarray, " views"] | Mapping[Any, float | None]]
    by: str = "view"
    unit: str = ""
    digits: int = 3
    less: bool = False


class Claim(NamedTuple):
    """What the paper says of a study: that its reference does better than other methods, or no worse.

    - `text`: in words.
    - `measure`, `at`: the number that tells, by its name and the view, or other key, that it is of.
    - `than`: the other methods.
    - `ahead`: whether it is to be better; otherwise it is not to be worse.
    """

    text: str
    measure: str
    at: Any
    than: tuple[str, ...]
    ahead: bool = True


def _seconds(record: Record, method: str) -> dict[str, float]:
    """The median over a scene's steps but the first, which may have compiled."""
    seconds = [step["seconds"] for step in record["methods"][method].get("steps", [])][1:]
    return {"median": float(np.median(seconds))} if seconds else {}


SECONDS = Measure("seconds", "Time of a proposal", _seconds, by="step", unit="seconds", digits=1, less=True)
