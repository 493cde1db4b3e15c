"""The part study's numbers: the paper's Table 1, differences between methods, and CSV files.

An object whose parts were not all found within the study's views counts with one view more than these, so that a mean
is a lower bound; the share that was found stands beside it.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxnbv.checks import require
from jaxnbv.experiments.parts.study import METHODS, TARGETS, discovery_time
from jaxnbv.experiments.statistics import LEVEL, paired_difference
from jaxnbv.experiments.tables import Row, count_of, standard_error, text_grid, underlined, write_csv

Record = dict[str, Any]

REFERENCE = "discrete"


def methods_of(records: Sequence[Record]) -> list[str]:
    """The methods that all records hold, in the order of `METHODS`.

    **Raises:** `ValueError` if there are no records, or no method that all of them hold.
    """
    require(len(records) > 0, "there are no records: run the study for at least one scene")
    common = [method for method in METHODS if all(method in record["methods"] for record in records)]
    require(len(common) > 0, f"the records have none of {', '.join(METHODS)} in common: run the same for all scenes")
    return common


def views_of(records: Sequence[Record]) -> int:
    """How many views the study had.

    **Raises:** `ValueError` if the records differ in it.
    """
    found = sorted({record["study_views"] for record in records})
    require(len(found) == 1, f"the records differ in their number of views, {found}: report each by itself")
    return found[0]


def discovery_times(records: Sequence[Record], methods: Sequence[str]) -> Int[np.ndarray, "scenes methods targets"]:
    """T_discovery for each of `TARGETS`; one more than the study's views where the parts were not all found."""
    never = views_of(records) + 1

    def time_of(run: dict, target: int) -> int:
        found = discovery_time(np.asarray(run["counts"]), target)
        return never if found is None else found

    return np.array(
        [[[time_of(record["methods"][m], target) for target in TARGETS] for m in methods] for record in records]
    )


def time_rows(records: Sequence[Record]) -> list[Row]:
    """Mean of T_discovery, its standard error and the share of the objects found, by method and N_target."""
    methods = methods_of(records)
    times, views = discovery_times(records, methods).astype(np.float64), views_of(records)
    means, errors, found = times.mean(axis=0), standard_error(times), np.mean(times <= views, axis=0)
    return [
        {"method": methods[m], "target": TARGETS[t], "mean": float(mean), "standard_error": float(errors[m, t])}
        | {"found": float(found[m, t]), "rank": int(np.sum(means[:, t] < mean)) + 1, "scenes": len(records)}
        for (m, t), mean in np.ndenumerate(means)
    ]


def difference_rows(records: Sequence[Record]) -> list[Row]:
    """T_discovery of the discrete search minus that of each other method over the same scenes, with intervals."""
    methods = methods_of(records)
    others = [method for method in methods if method != REFERENCE]
    if REFERENCE not in methods or not others:
        return []
    times = discovery_times(records, [REFERENCE, *others]).astype(np.float64)
    ours, theirs = np.broadcast_arrays(times[:, :1], times[:, 1:])
    estimate = paired_difference(np.asarray(ours), np.asarray(theirs), np.random.default_rng(0))
    return [
        {"method": REFERENCE, "baseline": others[m], "target": TARGETS[t], "mean": float(mean)}
        | {"low": float(estimate.low[m, t]), "high": float(estimate.high[m, t])}
        | {"excludes_zero": bool(estimate.excludes_zero[m, t]), "scenes": len(records)}
        for (m, t), mean in np.ndenumerate(estimate.mean)
    ]


def found_share(
    records: Sequence[Record], methods: Sequence[str], target: int
) -> Float[np.ndarray, "scenes methods views"]:
    """Whether all parts of each object had been found, by view."""
    times = discovery_times(records, methods)[:, :, TARGETS.index(target)]
    return (times[..., None] <= np.arange(1, views_of(records) + 1)).astype(np.float64)


def summary_table(records: Sequence[Record]) -> str:
    """The study as text: the paper's Table 1, the share found, and differences to the discrete search.

    **Raises:** `ValueError` if there are no records, or no method that all of them hold.
    """
    methods, columns, views = methods_of(records), [str(target) for target in TARGETS], views_of(records)
    times, differences = time_rows(records), difference_rows(records)
    cells = {(row["method"], str(row["target"])): _time(row) for row in times}
    shares = {(row["method"], str(row["target"])): f"{row['found']:.0%}" for row in times}
    sections = [
        underlined(f"Views until all parts are found: {count_of(len(records), 'scene')}"),
        "T_discovery for each N_target: views until the segmenter gives that many points to every part of the object.\n"
        f"Mean over scenes +- its standard error; ** the best, * the second. Not found within {views}: {views + 1}.\n",
        text_grid("N_target", methods, columns, cells),
        underlined(f"Objects whose parts were all found within {views} views"),
        text_grid("N_target", methods, columns, shares),
    ]
    if differences:
        others = [method for method in methods if method != REFERENCE]
        cells = {(row["baseline"], str(row["target"])): _difference(row) for row in differences}
        sections += [
            underlined(f"{REFERENCE} minus another method, the same scenes"),
            f"In [ ] the {LEVEL:.0%} bootstrap interval over scenes; * where it excludes zero. Negative is sooner.\n",
            text_grid("N_target", others, columns, cells),
        ]
    return "\n".join(sections)


def write_tables(records: Sequence[Record], folder: str | Path) -> list[Path]:
    """Write `results.txt`, the text of `summary_table`, and with one row a number `results.csv` and `differences.csv`.

    **Raises:** `ValueError` if there are no records, or no method that all of them hold.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    summary = folder / "results.txt"
    summary.write_text(summary_table(records), encoding="utf-8")
    times = ("method", "target", "mean", "standard_error", "found", "rank", "scenes")
    differences = ("method", "baseline", "target", "mean", "low", "high", "excludes_zero", "scenes")
    return [
        summary,
        write_csv(folder / "results.csv", time_rows(records), times),
        write_csv(folder / "differences.csv", difference_rows(records), differences),
    ]


def _time(row: Row) -> str:
    error = "" if np.isnan(row["standard_error"]) else f" +- {row['standard_error']:.2f}"
    return f"{row['mean']:.2f}{error}{ {1: '**', 2: '* '}.get(row['rank'], '  ') }"


def _difference(row: Row) -> str:
    return f"{row['mean']:+.2f} [{row['low']:+.2f}, {row['high']:+.2f}]{'*' if row['excludes_zero'] else ' '}"
