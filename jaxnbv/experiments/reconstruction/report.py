"""The reconstruction study's numbers: from the records of its scenes to the paper's table, differences and CSV files.

Intervals are 90 % percentile bootstraps over scenes, from the same resamples for all methods.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxnbv.checks import require
from jaxnbv.experiments.reconstruction.study import METHODS, RECONSTRUCTIONS
from jaxnbv.experiments.statistics import LEVEL, Estimate, bootstrap_mean, paired_difference
from jaxnbv.experiments.tables import Row, count_of, standard_error, text_grid, underlined, write_csv

Record = dict[str, Any]

QUANTITIES = {"chamfer": "CD", "hausdorff": "HD", "accuracy": "accuracy", "completeness": "completeness"}
REFERENCE = "coverage"
_COLUMNS = (
    ("reconstruction", "quantity", "method", "mean", "standard_error", "low", "high", "best", "scenes"),
    ("reconstruction", "quantity", "method", "baseline", "mean", "low", "high", "excludes_zero", "scenes"),
    ("method", "view", "mean", "low", "high", "scenes"),
)


def methods_of(records: Sequence[Record]) -> list[str]:
    """The methods that all records hold, in the order of `METHODS`.

    **Raises:** `ValueError` if there are no records, no method that all of them hold, or their numbers of views differ.
    """
    require(len(records) > 0, "there are no records: run the study for at least one scene")
    lengths = {len(method["candidates"]) for record in records for method in record["methods"].values()}
    require(len(lengths) == 1, f"the records differ in their number of views, {sorted(lengths)}: report each by itself")
    common = [method for method in METHODS if all(method in record["methods"] for record in records)]
    require(len(common) > 0, f"the records have none of {', '.join(METHODS)} in common: run the same for all scenes")
    return common


def distances(
    records: Sequence[Record], methods: Sequence[str], reconstruction: str
) -> Float[np.ndarray, "scenes quantities methods"]:
    """The `QUANTITIES` of a reconstruction, from those scenes in which every method has it."""
    of_scenes = [
        [record["methods"][method]["reconstructions"][reconstruction] for method in methods] for record in records
    ]
    values = [[[found[q] for found in scene] for q in QUANTITIES] for scene in of_scenes if None not in scene]
    return np.array(values, dtype=np.float64).reshape(-1, len(QUANTITIES), len(methods))


def coverages(records: Sequence[Record], methods: Sequence[str]) -> Float[np.ndarray, "scenes methods views"]:
    """The share of the true surface that is covered, by view."""
    return np.array([[record["methods"][method]["coverage"] for method in methods] for record in records])


def distance_rows(records: Sequence[Record]) -> list[Row]:
    """Mean, standard error and interval of each reconstruction, quantity and method; `best` is the least mean."""
    rows: list[Row] = []
    methods = methods_of(records)
    for reconstruction, values in _reconstructions(records, methods):
        estimate = bootstrap_mean(values, np.random.default_rng(0))
        error, scenes = standard_error(values), len(values)
        for (q, m), mean in np.ndenumerate(estimate.mean):
            rows.append(
                {"reconstruction": reconstruction, "quantity": list(QUANTITIES)[q], "method": methods[m]}
                | {"mean": float(mean), "standard_error": float(error[q, m])}
                | {"low": float(estimate.low[q, m]), "high": float(estimate.high[q, m])}
                | {"best": bool(mean == estimate.mean[q].min()), "scenes": scenes}
            )
    return rows


def difference_rows(records: Sequence[Record]) -> list[Row]:
    """Coverage minus each other method over the same scenes, with the interval of the difference."""
    rows: list[Row] = []
    methods = methods_of(records)
    others = [method for method in methods if method != REFERENCE]
    if REFERENCE not in methods or not others:
        return rows
    for reconstruction, values in _reconstructions(records, [REFERENCE, *others]):
        theirs = values[:, :, 1:]
        ours = np.broadcast_to(values[:, :, :1], theirs.shape)
        estimate = paired_difference(ours, theirs, np.random.default_rng(0))
        for (q, m), mean in np.ndenumerate(estimate.mean):
            rows.append(
                {"reconstruction": reconstruction, "quantity": list(QUANTITIES)[q]}
                | {"method": REFERENCE, "baseline": others[m], "mean": float(mean)}
                | {"low": float(estimate.low[q, m]), "high": float(estimate.high[q, m])}
                | {"excludes_zero": bool(estimate.excludes_zero[q, m]), "scenes": len(values)}
            )
    return rows


def coverage_rows(records: Sequence[Record]) -> list[Row]:
    """Mean and interval of the covered share of the true surface by method and view."""
    methods = methods_of(records)
    estimate = estimate_coverage(records, methods)
    return [
        {"method": methods[m], "view": v + 1, "mean": float(mean)}
        | {"low": float(estimate.low[m, v]), "high": float(estimate.high[m, v]), "scenes": len(records)}
        for (m, v), mean in np.ndenumerate(estimate.mean)
    ]


def estimate_coverage(records: Sequence[Record], methods: Sequence[str]) -> Estimate:
    """Mean and interval of `coverages` over scenes, with axes (methods, views)."""
    return bootstrap_mean(coverages(records, methods), np.random.default_rng(0))


def _reconstructions(
    records: Sequence[Record], methods: Sequence[str]
) -> list[tuple[str, Float[np.ndarray, "scenes quantities methods"]]]:
    """Those that at least one scene has."""
    found = [(name, distances(records, methods, name)) for name in RECONSTRUCTIONS]
    return [(name, values) for name, values in found if len(values)]


def write_tables(records: Sequence[Record], folder: str | Path) -> list[Path]:
    """Write the tables into a folder, and return their paths: `results.txt`, the text of `summary_table`, and with one
    row a number `results.csv`, `differences.csv` and `coverage.csv`.

    **Raises:** `ValueError` if there are no records, or their numbers of views differ.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    summary = folder / "results.txt"
    summary.write_text(summary_table(records), encoding="utf-8")
    tables = distance_rows(records), difference_rows(records), coverage_rows(records)
    paths = [folder / name for name in ("results.csv", "differences.csv", "coverage.csv")]
    for path, rows, columns in zip(paths, tables, _COLUMNS, strict=True):
        write_csv(path, rows, columns)
    return [summary, *paths]


def summary_table(records: Sequence[Record]) -> str:
    """The study as text: the paper's table for each reconstruction, differences between methods, coverage by view.

    **Raises:** `ValueError` if there are no records, or their numbers of views differ.
    """
    methods = methods_of(records)
    distance, difference = distance_rows(records), difference_rows(records)
    others = [method for method in methods if method != REFERENCE]
    views = len(records[0]["methods"][methods[0]]["candidates"])
    sections = [
        f"Distances to the true surface after {views} views, in scene units (longest side 2.5): less is better.\n"
        "Chamfer distance CD = accuracy + completeness: the mean distance from the reconstruction to the truth,\n"
        "and from the truth to the reconstruction. HD: the Hausdorff distance, the largest of both.\n"
        "Mean over scenes +- its standard error; * the best. Differences: coverage minus another method, in [ ] their\n"
        f"{LEVEL:.0%} bootstrap interval over scenes; * where it excludes zero.\n"
    ]
    for name in RECONSTRUCTIONS:
        here = [row for row in distance if row["reconstruction"] == name]
        if not here:
            sections.append(f"{name}: no scene has it; pip install pymeshlab and run the study again\n")
            continue
        title = f"{name}: {count_of(here[0]['scenes'], 'scene')}"
        cells = {(row["method"], QUANTITIES[row["quantity"]]): _distance(row) for row in here}
        sections.append(underlined(title))
        sections.append(text_grid("method", methods, list(QUANTITIES.values()), cells))
        here = [row for row in difference if row["reconstruction"] == name]
        cells = {(row["baseline"], QUANTITIES[row["quantity"]]): _difference(row) for row in here}
        if here:
            sections.append(text_grid(f"{REFERENCE} minus", others, list(QUANTITIES.values()), cells))
    title = f"share of the true surface that is covered, in percent: {count_of(len(records), 'scene')}"
    cells = {(row["method"], f"view {row['view']}"): _share(row) for row in coverage_rows(records)}
    sections.append(underlined(title))
    sections.append(text_grid("method", methods, [f"view {view + 1}" for view in range(views)], cells))
    return "\n".join(sections)


def _distance(row: Row) -> str:
    error = "" if math.isnan(row["standard_error"]) else f" +- {row['standard_error']:.3f}"
    return f"{row['mean']:.3f}{error}{'*' if row['best'] else ' '}"


def _difference(row: Row) -> str:
    return f"{row['mean']:+.3f} [{row['low']:+.3f}, {row['high']:+.3f}]{'*' if row['excludes_zero'] else ' '}"


def _share(row: Row) -> str:
    mean, low, high = (100.0 * row[key] for key in ("mean", "low", "high"))
    return f"{mean:3.0f} [{low:3.0f},{high:4.0f}]"
