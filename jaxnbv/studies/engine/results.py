"""What the records of a study say: means over scenes and paired differences, with bootstrap intervals, as tables."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy.stats import bootstrap

from jaxnbv.studies.engine.measures import Measure, Record, methods_of, values
from jaxnbv.studies.engine.study import Study

LEVEL = 0.90
_AT = ["quantity", "by", "at", "method"]
_MEANS = [*_AT, "mean", "standard_error", "low", "high", "rank", "scenes"]
_DIFFERENCES = [*_AT, "baseline", "mean", "low", "high", "excludes_zero", "scenes"]


class Results(NamedTuple):
    """A row a number, of each group of scenes: see `means` and `differences`."""

    means: pd.DataFrame
    differences: pd.DataFrame


def results(records: Sequence[Record], study: type[Study]) -> Results:
    """All measures of a study, of each group of its scenes.

    **Raises:** `ValueError` if there are no records, no method that all of them hold, or their numbers of views differ.
    """
    methods_of(records, study.methods)
    tables: tuple[list[pd.DataFrame], list[pd.DataFrame]] = [], []
    for group, members in study.groups(records).items():
        methods = methods_of(members, study.methods)
        found = means(members, methods, study.measures), differences(members, methods, study.measures, study.reference)
        for into, table in zip(tables, found, strict=True):
            table.insert(0, "group", group)
            into.append(table)
    return Results(*(pd.concat(of, ignore_index=True) for of in tables))


def interval(values: Float[np.ndarray, "scenes columns"]) -> Float[np.ndarray, "2 columns"]:
    """The ends of the percentile bootstrap interval of each column's mean, as Efron has it: whole scenes are drawn with
    replacement, the same for all columns. One scene alone has an interval without width."""
    if len(values) == 1:
        return np.repeat(values, 2, axis=0)
    settings = {"confidence_level": LEVEL, "method": "percentile", "rng": np.random.default_rng(0)}
    drawn = bootstrap((values,), np.mean, axis=0, **settings).confidence_interval
    return np.stack([drawn.low, drawn.high])


def means(records: Sequence[Record], methods: Sequence[str], measures: Sequence[Measure]) -> pd.DataFrame:
    """Mean, standard error and interval over scenes of each measure, column and method; `rank` counts from 1, where one
    is better than another. What is not paired has no interval; what no scene has has no row."""
    rows = []
    for measure, at, frame in _frames(records, methods, measures):
        known = frame.dropna() if measure.paired else frame.dropna(axis="columns", how="all")
        if known.empty:
            continue
        row = pd.DataFrame({"mean": known.mean(), "standard_error": known.sem(), "scenes": known.count()})
        row["low"], row["high"] = interval(known.to_numpy()) if measure.paired else (np.nan, np.nan)
        ranked = measure.paired and measure.better is not None
        row["rank"] = row["mean"].rank(method="min", ascending=measure.better == "less") if ranked else np.nan
        rows.append(_labelled(row, "method", measure, at))
    return _together(rows, _MEANS).astype({"rank": "Int64"})


def differences(
    records: Sequence[Record], methods: Sequence[str], measures: Sequence[Measure], reference: str
) -> pd.DataFrame:
    """The reference (`method`) less each other method (`baseline`) over the same scenes, with intervals; not of the
    first view, which all methods share."""
    rows = []
    for measure, at, frame in _frames(records, methods, measures):
        known = frame.dropna()
        others = known.columns.drop(reference, errors="ignore")
        if not measure.paired or reference not in known or known.empty or (measure.by, at) == ("view", 1):
            continue
        less = known[others].rsub(known[reference], axis=0)
        if less.empty:
            continue
        row = pd.DataFrame({"mean": less.mean(), "scenes": less.count(), "method": reference})
        row["low"], row["high"] = interval(less.to_numpy())
        row["excludes_zero"] = (row["low"] > 0) | (row["high"] < 0)
        rows.append(_labelled(row, "baseline", measure, at))
    return _together(rows, _DIFFERENCES)


def _frames(
    records: Sequence[Record], methods: Sequence[str], measures: Sequence[Measure]
) -> Iterator[tuple[Measure, Any, pd.DataFrame]]:
    """Of each measure and each of its columns a table: a row a scene, a column a method."""
    for measure in measures:
        found = values(records, methods, measure)
        for place, at in enumerate(measure.labels(found.shape[-1])):
            yield measure, at, pd.DataFrame(found[..., place], columns=list(methods))


def _labelled(row: pd.DataFrame, name: str, measure: Measure, at: Any) -> pd.DataFrame:
    return row.rename_axis(name).reset_index().assign(quantity=measure.name, by=measure.by, at=[at] * len(row))


def _together(rows: Sequence[pd.DataFrame], columns: list[str]) -> pd.DataFrame:
    return pd.concat(rows, ignore_index=True)[columns] if rows else pd.DataFrame(columns=columns)
