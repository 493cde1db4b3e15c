"""What a study measures: numbers of a record, by method and by view (or whatever else they are told by)."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxnbv.checks import require
from jaxnbv.studies.engine.statistics import Estimate, bootstrap_mean, paired_difference

# What is stored of one scene with every method.
Record = dict[str, Any]
Row = dict[str, Any]
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


def methods_of(records: Sequence[Record], known: Sequence[str]) -> list[str]:
    """The methods that all records hold: those of the study in its order, then others.

    **Raises:** `ValueError` if there are no records, or no method that all of them hold.
    """
    require(len(records) > 0, "there are no records: run the study for at least one scene")
    held = dict.fromkeys([*known, *(method for record in records for method in record["methods"])])
    common = [method for method in held if all(method in record["methods"] for record in records)]
    require(len(common) > 0, f"the records have none of {', '.join(held)} in common: run the same for all scenes")
    return common


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


def standard_error(values: Float[np.ndarray, "scenes *rest"]) -> Float[np.ndarray, "*rest"]:
    """Of the mean over scenes, element by element; NaN for a single scene."""
    if len(values) < 2:
        return np.full(values.shape[1:], np.nan)
    return np.asarray(values.std(axis=0, ddof=1) / np.sqrt(len(values)))


def result_rows(records: Sequence[Record], methods: Sequence[str], measures: Sequence[Measure]) -> list[Row]:
    """Mean, standard error and bootstrap interval over scenes of each measure, method and column; `rank` counts from 1.

    The same resamples of scenes for all methods. What is not paired has no interval; what no scene has has no row.
    """
    rows: list[Row] = []
    for measure in measures:
        for column, of_column in _columns(records, methods, measure):
            rows += (
                _paired(measure, column, methods, of_column)
                if measure.paired
                else _each(measure, column, methods, of_column)
            )
    return rows


def difference_rows(
    records: Sequence[Record], methods: Sequence[str], measures: Sequence[Measure], reference: str
) -> list[Row]:
    """The reference minus each other method over the same scenes, with bootstrap intervals; not of the first view,
    which all methods share."""
    others = [method for method in methods if method != reference]
    if reference not in methods or not others:
        return []
    rows: list[Row] = []
    for measure in measures:
        for column, of_column in _columns(records, [reference, *others], measure):
            known = _complete(of_column)
            if not measure.paired or not len(known) or (measure.by, column) == ("view", 1):
                continue
            ours, theirs = np.broadcast_arrays(known[:, :1], known[:, 1:])
            found = paired_difference(np.asarray(ours), np.asarray(theirs), np.random.default_rng(0))
            rows += [
                {"quantity": measure.name, "by": measure.by, "at": column, "method": reference, "baseline": other}
                | {"mean": float(found.mean[m]), "low": float(found.low[m]), "high": float(found.high[m])}
                | {"excludes_zero": bool(found.excludes_zero[m]), "scenes": len(known)}
                for m, other in enumerate(others)
            ]
    return rows


def _columns(records, methods, measure: Measure) -> list[tuple[Any, Float[np.ndarray, "scenes methods"]]]:
    found = values(records, methods, measure)
    return [(label, found[..., index]) for index, label in enumerate(measure.labels(found.shape[-1]))]


def _complete(of_column: Float[np.ndarray, "scenes methods"]) -> Float[np.ndarray, "known methods"]:
    return of_column[~np.isnan(of_column).any(axis=1)]


def _paired(measure: Measure, column: Any, methods: Sequence[str], of_column: np.ndarray) -> list[Row]:
    known = _complete(of_column)
    if not len(known):
        return []
    estimate: Estimate = bootstrap_mean(known, np.random.default_rng(0))
    sign = -1.0 if measure.better == "more" else 1.0
    ranks = [int(np.sum(sign * estimate.mean < sign * mean)) + 1 for mean in estimate.mean]
    errors = standard_error(known)
    return [
        {"quantity": measure.name, "by": measure.by, "at": column, "method": method, "mean": float(estimate.mean[m])}
        | {"standard_error": float(errors[m]), "low": float(estimate.low[m]), "high": float(estimate.high[m])}
        | {"rank": ranks[m] if measure.better else None, "scenes": len(known)}
        for m, method in enumerate(methods)
    ]


def _each(measure: Measure, column: Any, methods: Sequence[str], of_column: np.ndarray) -> list[Row]:
    known = {method: of[~np.isnan(of)] for method, of in zip(methods, of_column.T, strict=True)}
    nothing = {"low": None, "high": None, "rank": None}
    return [
        {"quantity": measure.name, "by": measure.by, "at": column, "method": method, "mean": float(of.mean())}
        | {"standard_error": float(standard_error(of)), **nothing, "scenes": len(of)}
        for method, of in known.items()
        if len(of)
    ]
