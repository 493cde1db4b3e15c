"""Statistics over the records of a study, tables of the statistics, and checks of the study's claims."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy.stats import bootstrap

from jaxnbv.checks import require
from jaxnbv.studies.engine.measures import WITHOUT_BANK, Measure, Record
from jaxnbv.studies.engine.study import Study

LEVEL = 0.90
_ALL = "all"
_POSITIONS = ("ahead of", "level with", "behind")


def results(records: Sequence[Record], study: type[Study]) -> pd.DataFrame:
    """Compute the statistics of all measures, one row per group of scenes, measure, key and method.

    The column `at` holds the key: a view, or another key of the measure. Each row holds the method's mean over the
    scenes, the standard error of the mean, and the bootstrap interval of the mean (`low`, `high`). The `lead` is the
    mean over the scenes of the reference method's value minus this method's, and `lead_low` and `lead_high` are its
    bootstrap interval. A method without values has no row. A scene counts only if all methods with a row have a value.

    **Raises:** `ValueError` if there are no records.
    """
    require(len(records) > 0, "there are no records: run the study for at least one scene")
    rows = []
    for record in records:
        for measure in study.measures:
            for method in record["methods"]:
                values = measure.compute(record, method)
                by_key = values if isinstance(values, Mapping) else dict(enumerate(values, start=1))
                labels = record["scene"], study.group(record), measure.name, measure.key_name, method
                rows += [(*labels, at, value) for at, value in by_key.items()]
    all_values = pd.DataFrame(rows, columns=["scene", "group", "quantity", "by", "method", "at", "value"])
    all_values["value"] = all_values["value"].astype(float)
    groups = all_values[all_values["group"] != ""].sort_values("group", kind="stable")
    keys = ["group", "quantity", "by", "at"]
    parts = pd.concat([all_values.assign(group=_ALL), groups]).groupby(keys, sort=False)
    tables = [_statistics(part, study.reference).assign(**dict(zip(keys, key, strict=True))) for key, part in parts]
    return pd.concat(tables, ignore_index=True)[[*keys, *tables[0].columns.drop(keys)]]


def _statistics(values: pd.DataFrame, reference: str) -> pd.DataFrame:
    """Return the rows of `results` for one group, measure and key, one row per method.

    - `values`: data frame with one row per scene and method, in the columns `scene`, `method` and `value`.
    """
    table = values.pivot(index="scene", columns="method", values="value")[values["method"].unique()]
    table = table.dropna(axis="columns", how="all").dropna()
    table = table if len(table) else table[[]]
    row = pd.DataFrame({"scenes": table.count(), "mean": table.mean(), "standard_error": table.sem()})
    row[["low", "high"]] = interval(table.to_numpy()).T
    row[["lead", "lead_low", "lead_high"]] = np.nan
    if reference in table:
        lead = table.rsub(table[reference], axis=0)
        row["lead"] = lead.mean()
        row[["lead_low", "lead_high"]] = interval(lead.to_numpy()).T
    return row.rename_axis("method").reset_index()


def interval(values: Float[np.ndarray, "scenes columns"]) -> Float[np.ndarray, "2 columns"]:
    """Return both ends of Efron's percentile bootstrap interval (of level `LEVEL`) for each column's mean.

    Scenes are drawn with replacement, and all columns use the same draws. For one scene, the interval has width zero.
    """
    if len(values) < 2:
        return np.stack([values.sum(axis=0)] * 2)
    settings = {"confidence_level": LEVEL, "method": "percentile", "rng": np.random.default_rng(0)}
    ends = bootstrap((values,), np.mean, axis=0, **settings).confidence_interval
    return np.stack([ends.low, ends.high])


def groups_of(table: pd.DataFrame) -> dict[str, int]:
    """Return the number of scenes in each group of a table. The first group, "all", has all scenes."""
    return table.groupby("group", sort=False)["scenes"].max().to_dict()


def tables(table: pd.DataFrame, study: type[Study], group: str = _ALL) -> list[tuple[str, pd.DataFrame]]:
    """Return the titles and cells (text) of two tables for each measure.

    In both, rows are methods, and columns are views or other keys. The first table has the means of the methods. The
    second has the leads: the reference's mean minus another method's. Empty tables are left out.

    - `table`: result of `results`.
    """
    texts = []
    for measure in study.measures:
        part = table[(table["group"] == group) & (table["quantity"] == measure.name)]
        unit = f" ({measure.unit})" if measure.unit else ""
        others = part[(part["method"] != study.reference) & ~((measure.key_name == "view") & (part["at"] == 1))]
        others = others.dropna(subset="lead")
        means = part.groupby("at", sort=False)["mean"]
        best = means.transform("min" if measure.lower_is_better else "max") == part["mean"]
        for title, rows, cells in (
            (f"{measure.title}{unit}, by {measure.key_name}", part, _means(part, measure, best)),
            (f"{measure.title}{unit}: {study.reference} minus another method", others, _leads(others, measure)),
        ):
            if len(rows):
                pivoted = rows.assign(text=cells).pivot(index="method", columns="at", values="text")
                ordered = pivoted.reindex(index=rows["method"].unique(), columns=rows["at"].unique()).fillna("-")
                texts.append((title, ordered.rename_axis(index=None, columns=measure.key_name)))
    return texts


def _means(rows: pd.DataFrame, measure: Measure, best: pd.Series) -> list[str]:
    """Format means in percent with intervals, other means with standard errors. A star marks the best."""
    texts = []
    for row, star in zip(rows.itertuples(), best, strict=True):
        if measure.unit == "%":
            text = f"{100 * row.mean:.0f} [{100 * row.low:.0f}, {100 * row.high:.0f}]"
        else:
            error = "" if pd.isna(row.standard_error) else f" +- {row.standard_error:.{measure.digits}f}"
            text = f"{row.mean:.{measure.digits}f}{error}"
        texts.append(text + _star(star))
    return texts


def _leads(rows: pd.DataFrame, measure: Measure) -> list[str]:
    """Format the leads of the reference over other methods. A star marks an interval that excludes zero."""
    form, scale = ("+.0f", 100) if measure.unit == "%" else (f"+.{measure.digits}f", 1)
    return [
        f"{scale * lead:{form}} [{scale * low:{form}}, {scale * high:{form}}]{_star(low > 0 or high < 0)}"
        for lead, low, high in zip(rows["lead"], rows["lead_low"], rows["lead_high"], strict=True)
    ]


def _star(is_marked: bool) -> str:
    """Return a star, or a space of the same width, so that right-aligned digits stay below one another."""
    return "*" if is_marked else " "


def summary(table: pd.DataFrame, study: type[Study]) -> str:
    """Return the tables of a study over all scenes as text."""
    title = f"{study.title}: {with_plural(groups_of(table)[_ALL], 'scene')}"
    sections = [f"{title}\n{'=' * len(title)}\n\n{study.explanation}\n{table_legend(study)}\n"]
    sections += [f"{title}\n{cells.to_string()}\n" for title, cells in tables(table, study)]
    return "\n".join(sections)


def table_legend(study: type[Study]) -> str:
    """Return the text that explains the cells of the tables."""
    return (
        f"Mean over scenes +- its standard error, or in percent; in [ ] the {LEVEL:.0%} bootstrap interval over\n"
        f"scenes; * the best. Differences: {study.reference} minus another method over the same scenes, * where the\n"
        "interval excludes zero."
    )


class Verdict(NamedTuple):
    """Result of the check of one claim.

    - `num_methods`: number of methods compared with the reference; `num_held`: for how many of them the claim holds.
    - `sentence`: text that lists the methods that the reference is ahead of, level with or behind.
    """

    claim: str
    num_held: int
    num_methods: int
    sentence: str


def verdicts(table: pd.DataFrame, study: type[Study]) -> list[Verdict]:
    """Check each claim: over all scenes, compare the study's reference with the methods of the claim.

    Runs of these methods without known shapes are compared too. The reference is "level with" a method if the interval
    of its lead includes zero. A claim is left out if none of its methods was run.
    """
    checks = []
    for claim in study.claims:
        (measure,) = (candidate for candidate in study.measures if candidate.name == claim.measure)
        claim_rows = table[(table["group"] == _ALL) & (table["quantity"] == claim.measure) & (table["at"] == claim.at)]
        rows = claim_rows[claim_rows["method"].str.removesuffix(WITHOUT_BANK).isin(claim.others)].dropna(subset="lead")
        by_position: dict[str, list[str]] = {position: [] for position in _POSITIONS}
        for row, text in zip(rows.itertuples(), _leads(rows, measure), strict=True):
            is_level = row.lead_low <= 0 <= row.lead_high
            is_better = (row.lead < 0) == measure.lower_is_better
            position = _POSITIONS[1 if is_level else 0 if is_better else 2]
            by_position[position].append(f"{row.method} ({text.rstrip('* ')})")
        if len(rows):
            num_held = sum(len(by_position[position]) for position in _POSITIONS[: 1 if claim.must_be_better else 2])
            parts = [f"{position} {', '.join(methods)}" for position, methods in by_position.items() if methods]
            sentence = f"Holds against {num_held} of {len(rows)}: {'; '.join(parts)}."
            checks.append(Verdict(claim.text, num_held, len(rows), sentence))
    return checks


def with_plural(count: int, noun: str) -> str:
    """Return the count with its noun, such as "1 scene" or "2 scenes"."""
    return f"{count} {noun}{'s' if count != 1 else ''}"
