"""Measures and claims of a study. A measure has one value per scene, method, and view or other key."""

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
    - `compute`: function that takes the record of a scene and the name of a method, and returns the method's values:
      either a sequence with one value per view, or a mapping from other keys to values. An undefined value is None or
      NaN.
    - `key_name`: what the keys are, such as "view".
    - `unit`: unit of the values; "%" for fractions in [0, 1], which are shown in percent.
    - `digits`: decimal places in tables.
    """

    name: str
    title: str
    compute: Callable[[Record, str], Sequence[float | None] | Float[np.ndarray, " views"] | Mapping[Any, float | None]]
    key_name: str = "view"
    unit: str = ""
    digits: int = 3
    lower_is_better: bool = False


class Claim(NamedTuple):
    """A claim that the study's reference method is better than other methods, or not worse.

    - `measure`: name of the measure that decides the claim; `at`: the view or other key whose values are compared.
    - `others`: the methods with which the reference is compared.
    - `must_be_better`: False if it is enough that the reference is not worse.
    """

    text: str
    measure: str
    at: Any
    others: tuple[str, ...]
    must_be_better: bool = True


def _seconds(record: Record, method: str) -> dict[str, float]:
    """Return the median time (seconds) of a method's proposals except the first, which may compile."""
    seconds = [step["seconds"] for step in record["methods"][method].get("steps", [])][1:]
    return {"median": float(np.median(seconds))} if seconds else {}


SECONDS = Measure(
    "seconds", "Time of a proposal", _seconds, key_name="step", unit="seconds", digits=1, lower_is_better=True
)
