"""Measures and claims of a study. A measure is computed from a record, for each method and each view or other key."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

# The stored results of all methods in one scene.
Record = dict[str, Any]
# Name of the model with known shapes, and suffix of a method that runs a second time without known shapes.
KNOWN, WITHOUT_BANK = "known", "-screened"


class Measure(NamedTuple):
    """One quantity of a study, shown as a table and as a panel of the chart.

    - `name`: name in files; `title`: name in tables and charts.
    - `of`: function that computes the values of a method from a record. It returns either a sequence with one value per
      view, starting at the first view, or a mapping from keys to values. An undefined value is None or NaN.
    - `by`: name of the keys, such as "view".
    - `unit`: unit of the values; "%" for fractions in [0, 1], which are shown in percent.
    - `digits`: decimal places in tables.
    - `less`: True if lower values are better.
    """

    name: str
    title: str
    of: Callable[[Record, str], Sequence[float | None] | Float[np.ndarray, " views"] | Mapping[Any, float | None]]
    by: str = "view"
    unit: str = ""
    digits: int = 3
    less: bool = False


class Claim(NamedTuple):
    """A claim of the paper that the study's reference method is better, or not worse, than others.

    - `text`: the claim in words.
    - `measure`: name of the measure that decides the claim; `at`: the view or other key at which it is compared.
    - `others`: the methods with which the reference is compared.
    - `must_be_better`: True if the reference must be better, False if it must not be worse.
    """

    text: str
    measure: str
    at: Any
    others: tuple[str, ...]
    must_be_better: bool = True


def _seconds(record: Record, method: str) -> dict[str, float]:
    """Return the median time of a scene's steps. The first step is left out, because it may include compilation."""
    seconds = [step["seconds"] for step in record["methods"][method].get("steps", [])][1:]
    return {"median": float(np.median(seconds))} if seconds else {}


SECONDS = Measure("seconds", "Time of a proposal", _seconds, by="step", unit="seconds", digits=1, less=True)
