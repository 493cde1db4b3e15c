"""The pyramid study's numbers: from the records of its scenes to shares by view, differences, tables and CSV files.

A record is what the study stores of one scene in one framing. Its shares lie in [0, 1]; bands and intervals are 90 %
percentile bootstraps over scenes, from the same resamples for all methods.
"""

import csv
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxnbv.checks import require
from jaxnbv.experiments.pyramid.hits import (
    PATTERN_PIXELS,
    cumulative_share,
    first_hit,
    pattern_view,
    random_pattern_share,
    stable_hit,
)
from jaxnbv.experiments.statistics import LEVEL, Estimate, bootstrap_mean, paired_difference

Record = dict[str, Any]
Row = dict[str, Any]

METHODS = ("cross-entropy", "entropy", "mixed", "coverage", "farthest", "uncertainty", "random", "oracle")
QUANTITIES = {
    "first": "first hit",
    "stable": "stable hit",
    "pattern": "pattern seen",
}
DIAGNOSTICS = {
    "rank_correlation": "rank correlation",
    "roughness": "roughness",
    "near_sensor": "near-sensor share",
}
BASELINES = ("farthest", "uncertainty", "random", "coverage")
_COMPARED_VIEWS = (2, 3)
_COLUMNS = (
    ("mean", "low", "high", "scenes"),
    ("baseline", "mean", "low", "high", "excludes_zero", "scenes"),
    ("mean", "scenes"),
)
# Of the cameras from which the pattern cannot be seen two fifths lie in each of the first two, a fifth in the last.
_ANGLES = {"under 110": (0.0, 110.0), "110-140": (110.0, 140.0), "140-180": (140.0, 180.1)}


def methods_of(records: Sequence[Record]) -> list[str]:
    """The methods that all records hold, in the order of `METHODS`.

    **Raises:** `ValueError` if there are no records, no method that all of them hold, or their numbers of views differ.
    """
    require(len(records) > 0, "there are no records: run the study for at least one scene")
    lengths = {len(run["log_p"]) for r in records for method in r["methods"].values() for run in method["runs"]}
    require(len(lengths) == 1, f"the records differ in their number of views, {sorted(lengths)}: report each by itself")
    common = [method for method in METHODS if all(method in record["methods"] for record in records)]
    require(len(common) > 0, f"the records have none of {', '.join(METHODS)} in common: run the same for all scenes")
    return common


def by_framing(records: Sequence[Record]) -> dict[str, list[Record]]:
    """The records of each framing, ordered by scene."""
    framings = sorted({record["framing"] for record in records})
    ordered = sorted(records, key=lambda record: record["scene"])
    return {framing: [record for record in ordered if record["framing"] == framing] for framing in framings}


def by_angle(records: Sequence[Record]) -> dict[str, list[Record]]:
    """All records, and those in each bin of the first view's angle from the base's normal in degrees; no bin is empty.

    At 180 the first camera looks from behind the apex.
    """
    bins = {name: [r for r in records if low <= r["angle"] < high] for name, (low, high) in _ANGLES.items()}
    return {"all": list(records), **{name: members for name, members in bins.items() if members}}


def curves(records: Sequence[Record], method: str, quantity: str) -> Float[np.ndarray, "scenes views"]:
    """For each scene the probability, by view, that a method has

    - `"pattern"`: shown at least 150 pixels of the pattern in one view;
    - `"first"`: predicted the right class at least once;
    - `"stable"`: begun to predict it for good.

    It is the mean over the method's runs, for all but random search that of one run: 0 or 1. Of random search the
    pattern is exact over all orders, and so is the first hit by view 2.

    **Raises:** `ValueError` for another quantity.
    """
    require(quantity in QUANTITIES, f"the quantity is {quantity!r}; it must be one of {', '.join(QUANTITIES)}")
    return np.stack([_curve(record, method, quantity) for record in records])


def _curve(record: Record, method: str, quantity: str) -> Float[np.ndarray, " views"]:
    runs = record["methods"][method]["runs"]
    views = len(runs[0]["log_p"])
    if quantity == "pattern":
        if method == "random":
            return random_pattern_share(np.array(record["pattern_pixels"]), record["first"], views)
        return cumulative_share([pattern_view(np.array(run["pattern_pixels"])) for run in runs], views)
    time_of: Callable = first_hit if quantity == "first" else stable_hit
    correct = [np.argmax(run["log_p"], axis=1) == record["label"] for run in runs]
    share = cumulative_share([time_of(run) for run in correct], views)
    if method == "random" and quantity == "first" and views >= 2:
        # All runs have the first view in common.
        share[1] = 1.0 if correct[0][0] else record["random_hit"]
    return share


def estimate_shares(records: Sequence[Record], methods: Sequence[str]) -> Estimate:
    """Mean and band of the curves over scenes, with axes (quantities, methods, views)."""
    return bootstrap_mean(_all_curves(records, methods), np.random.default_rng(0))


def _all_curves(
    records: Sequence[Record], methods: Sequence[str]
) -> Float[np.ndarray, "scenes quantities methods views"]:
    values = [[curves(records, method, quantity) for method in methods] for quantity in QUANTITIES]
    return np.moveaxis(np.array(values), 2, 0)


def share_rows(records: Sequence[Record]) -> list[Row]:
    """Mean and band of each quantity, method and view, for each framing and bin of angles."""
    rows: list[Row] = []
    for framing, angle, members in _groups(records):
        methods = methods_of(members)
        estimate = estimate_shares(members, methods)
        for (q, m, v), mean in np.ndenumerate(estimate.mean):
            rows.append(
                {"framing": framing, "angle": angle, "quantity": list(QUANTITIES)[q], "view": v + 1}
                | {"method": methods[m], "mean": float(mean)}
                | {"low": float(estimate.low[q, m, v]), "high": float(estimate.high[q, m, v]), "scenes": len(members)}
            )
    return rows


def difference_rows(records: Sequence[Record]) -> list[Row]:
    """Cross-entropy minus each baseline at views 2 and 3, over the same scenes, with the interval of the difference."""
    rows: list[Row] = []
    for framing, angle, members in _groups(records):
        methods = methods_of(members)
        baselines = [method for method in BASELINES if method in methods]
        if "cross-entropy" not in methods or not baselines:
            continue
        ours, theirs = _all_curves(members, ["cross-entropy"]), _all_curves(members, baselines)
        estimate = paired_difference(np.broadcast_to(ours, theirs.shape), theirs, np.random.default_rng(0))
        for (q, b, v), mean in np.ndenumerate(estimate.mean):
            if v + 1 in _COMPARED_VIEWS:
                rows.append(
                    {"framing": framing, "angle": angle, "quantity": list(QUANTITIES)[q], "view": v + 1}
                    | {"method": "cross-entropy", "baseline": baselines[b], "mean": float(mean)}
                    | {"low": float(estimate.low[q, b, v]), "high": float(estimate.high[q, b, v])}
                    | {"excludes_zero": bool(estimate.excludes_zero[q, b, v]), "scenes": len(members)}
                )
    return rows


def diagnostic_rows(records: Sequence[Record]) -> list[Row]:
    """Mean over scenes of each diagnostic by the view being chosen and the method whose views made the posterior.

    The rank correlation is that of the method's own acquisition. A scene in which a diagnostic is not defined, such as
    the correlation with a pattern that no candidate would see, is left out of its mean and of `scenes`.
    """
    rows: list[Row] = []
    for framing, angle, members in _groups(records):
        views = sorted({entry["view"] for record in members for entry in record["diagnostics"]})
        for quantity, method, view in product(DIAGNOSTICS, methods_of(members), views):
            of_scenes = [_diagnostic(record, quantity, method, view) for record in members]
            known = [value for value in of_scenes if value is not None]
            if known:
                rows.append(
                    {"framing": framing, "angle": angle, "quantity": quantity, "view": view, "method": method}
                    | {"mean": float(np.mean(known)), "scenes": len(known)}
                )
    return rows


def _diagnostic(record: Record, quantity: str, method: str, view: int) -> float | None:
    """A scene's value, the mean over the method's posteriors of that view; None where there is none."""
    entries = [entry for entry in record["diagnostics"] if entry["view"] == view and method in entry["methods"]]
    if quantity == "rank_correlation":
        values = [entry[quantity].get(method) for entry in entries]
    else:
        values = [entry[quantity] for entry in entries]
    known = [value for value in values if value is not None and np.isfinite(value)]
    return float(np.mean(known)) if known else None


def _groups(records: Sequence[Record]) -> list[tuple[str, str, list[Record]]]:
    return [
        (framing, angle, members)
        for framing, of_framing in by_framing(records).items()
        for angle, members in by_angle(of_framing).items()
    ]


def write_tables(records: Sequence[Record], folder: str | Path) -> list[Path]:
    """Write the tables into a folder, and return their paths: `results.txt`, the text of `summary_table`, and with one
    row a number `results.csv`, `differences.csv` and `diagnostics.csv`.

    **Raises:** `ValueError` if there are no records, or their numbers of views differ.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    tables = _tables(records)
    summary = folder / "results.txt"
    summary.write_text(_summary(records, *tables), encoding="utf-8")
    paths = [folder / name for name in ("results.csv", "differences.csv", "diagnostics.csv")]
    for path, rows, columns in zip(paths, tables, _COLUMNS, strict=True):
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, ["framing", "angle", "quantity", "view", "method", *columns])
            writer.writeheader()
            for row in rows:
                writer.writerow({key: round(x, 6) if isinstance(x, float) else x for key, x in row.items()})
    return [summary, *paths]


def _tables(records: Sequence[Record]) -> tuple[list[Row], list[Row], list[Row]]:
    methods_of(records)
    return share_rows(records), difference_rows(records), diagnostic_rows(records)


def summary_table(records: Sequence[Record], by_angle: bool = True) -> str:
    """The study as text: shares by view in percent, differences in percentage points, diagnostics; each for all scenes
    of a framing, then, if `by_angle`, by the angle of the first view.

    **Raises:** `ValueError` if there are no records, or their numbers of views differ.
    """
    return _summary(records, *_tables(records), by_angle)


def _summary(
    records: Sequence[Record], shares: list[Row], differences: list[Row], diagnostics: list[Row], by_angle: bool = True
) -> str:
    intro = (
        f"Share of scenes, in percent, in [ ] its {LEVEL:.0%} bootstrap band over scenes.\n"
        "First hit: a right prediction so far. Stable hit: right from then to the end.\n"
        f"Pattern seen: one of the views shows at least {PATTERN_PIXELS} pixels of it.\n"
        "Angles are of the first view from the base's normal, in degrees.\n"
        "Random search: exact expectation of pattern seen and of first hit by view 2, else a mean over runs.\n"
    )
    sections = [intro]
    for framing, angle, members in _groups(records):
        if angle != "all" and not by_angle:
            continue
        scenes = f"{len(members)} scene{'s' if len(members) != 1 else ''}"
        title = f"{framing}, {'all angles' if angle == 'all' else f'angle {angle}'}: {scenes}"
        sections.append(f"{title}\n{'=' * len(title)}\n")
        here = {"framing": framing, "angle": angle}
        for quantity, name in QUANTITIES.items():
            sections.append(_pivot(name, "method", _select(shares, here, quantity), _percent))
        for quantity, name in QUANTITIES.items():
            title = f"{name}: cross-entropy minus a baseline, in points; * where the interval excludes zero"
            sections.append(_pivot(title, "baseline", _select(differences, here, quantity), _points))
        for quantity, name in DIAGNOSTICS.items():
            title = f"{name} by the view being chosen: mean, and in ( ) its number of scenes"
            sections.append(_pivot(title, "method", _select(diagnostics, here, quantity), _count))
    return "\n".join(section for section in sections if section)


def _select(rows: list[Row], here: Row, quantity: str) -> list[Row]:
    return [row for row in rows if here.items() <= row.items() and row["quantity"] == quantity]


def _percent(row: Row) -> str:
    mean, low, high = (100.0 * row[key] for key in ("mean", "low", "high"))
    return f"{mean:3.0f} [{low:3.0f},{high:4.0f}]"


def _points(row: Row) -> str:
    mean, low, high = (100.0 * row[key] for key in ("mean", "low", "high"))
    return f"{mean:+4.0f} [{low:+4.0f},{high:+5.0f}]{'*' if row['excludes_zero'] else ' '}"


def _count(row: Row) -> str:
    return f"{row['mean']:.2f} ({row['scenes']:3d})"


def _pivot(title: str, key: str, rows: Sequence[Row], write: Callable[[Row], str]) -> str:
    """One line for each value of `key`, one column a view, aligned; nothing for no rows."""
    if not rows:
        return ""
    views = sorted({row["view"] for row in rows})
    names = list(dict.fromkeys(row[key] for row in rows))
    cells = {(row[key], row["view"]): write(row) for row in rows}
    width = max(map(len, (*cells.values(), "view 1"))) + 2
    head = f"{title}\n  {'':15}" + "".join(f"{f'view {view}':>{width}}" for view in views)
    lines = [f"  {name:15}" + "".join(f"{cells.get((name, view), '-'):>{width}}" for view in views) for name in names]
    return "\n".join(line.rstrip() for line in [head, *lines]) + "\n"
