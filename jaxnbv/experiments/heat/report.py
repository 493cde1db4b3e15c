"""The heat study's numbers: distances to the coldest point by view, differences between methods, searches compared."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxnbv.checks import require
from jaxnbv.experiments.heat.study import ESTIMATES, HEAT_METHODS, METHODS
from jaxnbv.experiments.statistics import LEVEL, Estimate, bootstrap_mean, paired_difference
from jaxnbv.experiments.tables import Row, count_of, standard_error, text_grid, underlined, write_csv

Record = dict[str, Any]

REFERENCE = "heat"
# What is measured of each estimate of the coldest point, and how its title reads.
QUANTITIES = {
    "distance": "distance to the object's coldest points",
    "point_distance": "distance to the object's coldest point",
    "error": "error of the lowest temperature",
}
UNITS = {"distance": "scene units", "point_distance": "scene units", "error": "degrees"}
_AMONG = {"all": "all points", "reached": "points that the source warms"}
# Those that the text shows; the CSV files have all.
_SHOWN = ("distance", "error")


def methods_of(records: Sequence[Record]) -> list[str]:
    """The methods that all records hold, in the order of `METHODS`.

    **Raises:** `ValueError` if there are no records, no method that all of them hold, or their numbers of views differ.
    """
    require(len(records) > 0, "there are no records: run the study for at least one scene")
    common = [method for method in METHODS if all(method in record["methods"] for record in records)]
    require(len(common) > 0, f"the records have none of {', '.join(METHODS)} in common: run the same for all scenes")
    views = sorted({len(run["candidates"]) for record in records for run in record["methods"].values()})
    require(len(views) == 1, f"the records differ in their number of views, {views}: report each by itself")
    return common


def measured(
    records: Sequence[Record], methods: Sequence[str], quantity: str, estimate: str
) -> Float[np.ndarray, "scenes methods views"]:
    """One of `QUANTITIES`, not negative, of one of `ESTIMATES`, by view."""

    def of_run(record: Record, method: str) -> Float[np.ndarray, " views"]:
        found = record["methods"][method]["estimates"][estimate]
        if quantity == "error":
            return np.abs(np.array(found["temperatures"]) - record["truth"]["temperature"])
        return np.array(found[f"{quantity}s"])

    return np.array([[of_run(record, method) for method in methods] for record in records])


def estimate_means(records: Sequence[Record], methods: Sequence[str], quantity: str, estimate: str) -> Estimate:
    """Means over scenes with bootstrap intervals, each (methods, views)."""
    return bootstrap_mean(measured(records, methods, quantity, estimate), np.random.default_rng(0))


def quantity_rows(records: Sequence[Record]) -> list[Row]:
    """Mean and standard error over scenes of each quantity of each estimate, by method and view."""
    methods, rows = methods_of(records), []
    for estimate, quantity in ((e, q) for e in ESTIMATES for q in QUANTITIES):
        values = measured(records, methods, quantity, estimate)
        means, errors = values.mean(axis=0), standard_error(values)
        rows += [
            {"estimate": estimate, "quantity": quantity, "method": methods[m], "view": v + 1, "mean": float(mean)}
            | {"standard_error": float(errors[m, v]), "scenes": len(records)}
            for (m, v), mean in np.ndenumerate(means)
        ]
    return rows


def difference_rows(records: Sequence[Record]) -> list[Row]:
    """The paper's method minus each other one over the same scenes, with bootstrap intervals, from the second view."""
    methods = methods_of(records)
    others = [method for method in methods if method != REFERENCE]
    if REFERENCE not in methods or not others:
        return []
    rows = []
    for estimate, quantity in ((e, q) for e in ESTIMATES for q in QUANTITIES):
        values = measured(records, [REFERENCE, *others], quantity, estimate)[:, :, 1:]
        ours, theirs = np.broadcast_arrays(values[:, :1], values[:, 1:])
        found = paired_difference(np.asarray(ours), np.asarray(theirs), np.random.default_rng(0))
        rows += [
            {"estimate": estimate, "quantity": quantity, "method": REFERENCE, "baseline": others[m], "view": v + 2}
            | {"mean": float(mean), "low": float(found.low[m, v]), "high": float(found.high[m, v])}
            | {"excludes_zero": bool(found.excludes_zero[m, v]), "scenes": len(records)}
            for (m, v), mean in np.ndenumerate(found.mean)
        ]
    return rows


def saturation_rows(records: Sequence[Record]) -> list[Row]:
    """Of the methods that seek cold: the share of the steps at which every view had the value zero, by view chosen."""
    return [
        {"method": method, "view": view, "saturated": float(np.mean(values)), "scenes": len(records)}
        for method in methods_of(records)
        if method in HEAT_METHODS
        for view, values in enumerate(
            zip(*([step["value"] == 0.0 for step in r["methods"][method]["steps"]] for r in records), strict=True),
            start=2,
        )
    ]


def halving_rows(records: Sequence[Record]) -> list[Row]:
    """The two searches on the same states and samples: one row, or none where they were not compared.

    Steps at which every view had the value zero are left out, but for the seconds, which are medians over all steps.
    """
    runs = [record["methods"][REFERENCE] for record in records if REFERENCE in record["methods"]]
    pairs = [pair for run in runs for pair in zip(run["steps"], run.get("halving", ()), strict=False)]
    if not pairs:
        return []
    open_pairs = [(full, halved) for full, halved in pairs if full["value"] > 0.0]

    def mean(values: list) -> float:
        return float(np.mean(values)) if values else float("nan")

    return [
        {"steps": len(pairs), "open_steps": len(open_pairs)}
        | {"same_view": mean([halved["same"] for _, halved in open_pairs])}
        | {"mean_regret": mean([halved["regret"] for _, halved in open_pairs])}
        | {"mean_value": mean([full["value"] for full, _ in open_pairs])}
        | {name: pairs[0][1][name] for name in ("full_evaluations", "evaluations")}
        | {"full_seconds": float(np.median([full["seconds"] for full, _ in pairs]))}
        | {"seconds": float(np.median([halved["seconds"] for _, halved in pairs]))}
    ]


def summary_table(records: Sequence[Record]) -> str:
    """The study as text: distance and error by view, differences to the paper's method, saturation, searches.

    **Raises:** as `methods_of`.
    """
    methods = methods_of(records)
    views = len(records[0]["methods"][methods[0]]["candidates"])
    columns = [str(view) for view in range(1, views + 1)]
    rows, differences = quantity_rows(records), difference_rows(records)
    sections = [
        underlined(f"The coldest point: {count_of(len(records), 'scene')}"),
        "The estimate is the coldest of all points of the cloud, as in the paper, or of those that the source warms.\n"
        "The object's coldest points are those within 1 % of its range of temperatures of the lowest.\n"
        "Mean over scenes +- its standard error, by view.\n",
    ]
    for estimate, quantity in ((e, q) for e in ESTIMATES for q in _SHOWN):
        cells = {(row["method"], str(row["view"])): _mean(row) for row in _of(rows, estimate, quantity)}
        title = f"{QUANTITIES[quantity].capitalize()} ({UNITS[quantity]}), estimate among {_AMONG[estimate]}"
        sections += [underlined(title), text_grid("view", methods, columns, cells)]
    others = [method for method in methods if method != REFERENCE]
    for estimate in ESTIMATES if differences else ():
        found = _of(differences, estimate, "distance")
        cells = {(row["baseline"], str(row["view"])): _difference(row) for row in found}
        sections += [
            underlined(f"{REFERENCE} minus another method: distance, estimate among {_AMONG[estimate]}"),
            f"In [ ] the {LEVEL:.0%} bootstrap interval over scenes; * where it excludes zero. Negative is nearer.\n",
            text_grid("view", others, columns[1:], cells),
        ]
    return "\n".join([*sections, *_saturation(records, columns[1:]), *_halving(records)])


def _saturation(records: Sequence[Record], columns: Sequence[str]) -> list[str]:
    rows = saturation_rows(records)
    cells = {(row["method"], str(row["view"])): f"{row['saturated']:.0%}" for row in rows}
    return [
        underlined("Steps at which every view had the value zero, by the view that was to be chosen"),
        "The first candidate is taken then. The lowest temperature is already that before heating, at a piece of the\n"
        "cloud that is not connected to the source, and no scan can lower it.\n",
        text_grid("view", list(dict.fromkeys(row["method"] for row in rows)), columns, cells),
    ] * bool(rows)


def _halving(records: Sequence[Record]) -> list[str]:
    return [
        underlined("Successive halving in place of the full search, same states and samples")
        + f"{row['open_steps']} of {count_of(row['steps'], 'step')} have a view of a value above zero. Of these:\n"
        f"  the same view:           {row['same_view']:.0%}\n"
        f"  mean loss of value:      {row['mean_regret']:.4f} of {row['mean_value']:.4f} degrees\n"
        "All steps:\n"
        f"  imagined scans scored:   {row['evaluations']} in place of {row['full_evaluations']}\n"
        f"  seconds, median:         {row['seconds']:.1f} in place of {row['full_seconds']:.1f}\n"
        for row in halving_rows(records)
    ]


def write_tables(records: Sequence[Record], folder: str | Path) -> list[Path]:
    """Write `results.txt`, the text of `summary_table`, and with one row a number `results.csv`, `differences.csv`,
    `saturation.csv` and `halving.csv`; return the paths.

    **Raises:** as `methods_of`.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    summary = folder / "results.txt"
    summary.write_text(summary_table(records), encoding="utf-8")
    of_number = ("mean", "standard_error", "scenes")
    interval = ("mean", "low", "high", "excludes_zero", "scenes")
    halving = ("steps", "open_steps", "same_view", "mean_regret", "mean_value")
    costs = ("full_evaluations", "evaluations", "full_seconds", "seconds")
    tables = {
        "results": (quantity_rows(records), ("estimate", "quantity", "method", "view", *of_number)),
        "differences": (difference_rows(records), ("estimate", "quantity", "method", "baseline", "view", *interval)),
        "saturation": (saturation_rows(records), ("method", "view", "saturated", "scenes")),
        "halving": (halving_rows(records), (*halving, *costs)),
    }
    return [summary, *(write_csv(folder / f"{name}.csv", rows, columns) for name, (rows, columns) in tables.items())]


def _of(rows: Sequence[Row], estimate: str, quantity: str) -> list[Row]:
    return [row for row in rows if (row["estimate"], row["quantity"]) == (estimate, quantity)]


def _mean(row: Row) -> str:
    error = "" if np.isnan(row["standard_error"]) else f" +- {row['standard_error']:.3f}"
    return f"{row['mean']:.3f}{error}"


def _difference(row: Row) -> str:
    return f"{row['mean']:+.3f} [{row['low']:+.3f}, {row['high']:+.3f}]{'*' if row['excludes_zero'] else ' '}"
