"""What a study measures: numbers of a record, by method and by view (or whatever else they are told by)."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxnbv.checks import require

# What is stored of one scene with every method.
Record = dict[str, Any]
# The model of studies that know shapes, and the end of the name of a method that is run once more without them.
KNOWN, UNKNOWING = "known", "-screened"


class Measure(NamedTuple):
    """One quantity of a study.

    - `name`: in files; `title`: in words.
    - `of`: its values in a record with a method, one a column; None or NaN where it is not defined.
    - `columns`: what the values are of, by default the views from `first` on; `by`: what that is called.
    - `unit`: of the values, which lie in [0, 1] if they are shares (`percent`).
    - `better`: "less" or "more"; None where neither is.
    - `paired`: methods are compared over the scenes in which all of them have a value. Otherwise each has its own mean.
    - `listed`: whether the text shows it; the files have all.
    """

    name: str
    title: str
    of: Callable[[Record, str], Sequence[float | None] | Float[np.ndarray, " columns"]]
    columns: Sequence[Any] | None = None
    by: str = "view"
    first: int = 1
    unit: str = ""
    percent: bool = False
    digits: int = 3
    better: str | None = None
    paired: bool = True
    listed: bool = True

    def labels(self, count: int) -> list[Any]:
        """What each of so many values is of."""
        return list(range(self.first, self.first + count)) if self.columns is None else list(self.columns)


class Claim(NamedTuple):
    """What the paper says of a study: that its reference does better than other methods, or no worse.

    - `text`: in words.
    - `measure`, `at`: the number that tells, by its name and its column.
    - `than`: the other methods.
    - `ahead`: whether it is to be better; otherwise it is not to be worse.
    """

    text: str
    measure: str
    at: Any
    than: tuple[str, ...]
    ahead: bool = True


def methods_of(records: Sequence[Record], known: Sequence[str], among: Sequence[str] = ()) -> list[str]:
    """The methods that all records hold: those of the study in its order, then others; of these those `among` some
    alone, if there are any.

    **Raises:** `ValueError` if there are no records, or no method that all of them hold.
    """
    require(len(records) > 0, "there are no records: run the study for at least one scene")
    held = dict.fromkeys([*known, *(method for record in records for method in record["methods"])])
    common = [method for method in held if all(method in record["methods"] for record in records)]
    require(len(common) > 0, f"the records have none of {', '.join(held)} in common: run the same for all scenes")
    return [method for method in among if method in common] or common


def values(
    records: Sequence[Record], methods: Sequence[str], measure: Measure
) -> Float[np.ndarray, "scenes methods columns"]:
    """NaN where a value is not defined.

    **Raises:** `ValueError` if the records differ in their number of views.
    """
    found = [[list(measure.of(record, method)) for method in methods] for record in records]
    lengths = sorted({len(row) for rows in found for row in rows})
    require(len(lengths) == 1, f"the records differ in their number of views, {lengths}: report each by itself")
    return np.array(found, dtype=np.float64)
