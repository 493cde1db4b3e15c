"""Measures of a study, computed from a record by method and by view or another key, and its claims."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

# The stored result of one scene with all methods.
Record = dict[str, Any]
# The model with known shapes, and the suffix of a method that runs a second time without them.
KNOWN, WITHOUT_BANK = "known", "-screened"


class Measure(NamedTuple):
    """One quantity of a study, shown as a table and as a panel of the chart.

    - `name`: name in files; `title`: name in tables and charts.
    - `of`: function from a record and a method to values: a sequence by view, from the first, or a mapping. None or NaN
      if a value is undefined.
    - `by`: what the keys of a mapping are.
    - `unit`: unit of the values; "%" for shares in [0, 1].
    - `digits`: decimal places in tables.
    - `less`: whether lower values are better.
    """

    name: str
    title: str
    of: Callable[[Record, str], Sequence[float | None] | Float[np.ndarray, " views"] | Mapping[Any, float | None]]
    by: str = "view"
    unit: str = ""
    digits: int = 3
    less: bool = False


class Claim(NamedTuple):
    """A claim of the paper: the study's reference does better than other methods, or no worse.

    - `text`: the claim in words.
    - `measure`, `at`: name of the measure that decides, and its view or other key.
    - `others`: the other methods.
    - `must_be_better`: True if the reference must be better, False if it must not be worse.
    """

    text: str
    measure: str
    at: Any
    others: tuple[str, ...]
    must_be_better: bool = True


def _seconds(record: Record, method: str) -> dict[str, float]:
    """Median over a scene's steps, without the first, which may include compilation."""
    seconds = [step["seconds"] for step in record["methods"][method].get("steps", [])][1:]
    return {"median": float(np.median(seconds))} if seconds else {}


SECONDS = Measure("seconds", "Time of a proposal", _seconds, by="step", unit="seconds", digits=1, less=True)
