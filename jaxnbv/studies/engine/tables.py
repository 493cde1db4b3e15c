"""Tables of a study: aligned text, and CSV with one row a number."""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from jaxnbv.storage.files import make_folder, write_text
from jaxnbv.studies.engine.measures import Measure, Record, Row, difference_rows, methods_of, result_rows
from jaxnbv.studies.engine.statistics import LEVEL
from jaxnbv.studies.engine.study import Study

_RESULT = ("group", "quantity", "by", "at", "method", "mean", "standard_error", "low", "high", "rank", "scenes")
_DIFFERENCE = ("group", "quantity", "by", "at", "method", "baseline", "mean", "low", "high", "excludes_zero", "scenes")
_MARKS = {1: "**", 2: "* "}


def write_tables(records: Sequence[Record], study: type[Study], folder: str | Path) -> list[Path]:
    """Write the tables of a study into a folder, and return their paths: `results.txt`, the text of `summary`, and
    with one row a number `results.csv`, `differences.csv` and what else the study has.

    **Raises:** `ValueError` if there are no records, no method that all of them hold, or their numbers of views differ.
    """
    folder = make_folder(folder)
    results, differences = all_rows(records, study)
    text = folder / "results.txt"
    write_text(text, _text(records, study, results, differences))
    paths = [
        write_csv(folder / "results.csv", results, _RESULT),
        write_csv(folder / "differences.csv", differences, _DIFFERENCE),
    ]
    own = [
        write_csv(folder / f"{name}.csv", rows, list(rows[0])) for name, rows in study.own_rows(records).items() if rows
    ]
    return [text, *paths, *own]


def all_rows(records: Sequence[Record], study: type[Study]) -> tuple[list[Row], list[Row]]:
    """Results and differences, of each group of scenes."""
    methods_of(records, study.methods)
    results, differences = [], []
    for group, members in study.groups(records).items():
        methods, label = methods_of(members, study.methods), {"group": group}
        results += [label | row for row in result_rows(members, methods, study.measures)]
        differences += [label | row for row in difference_rows(members, methods, study.measures, study.reference)]
    return results, differences


def summary(records: Sequence[Record], study: type[Study], groups: bool = True) -> str:
    """A study as text: its measures by method, differences to its reference, and what else it tells.

    - `groups`: of each group of its scenes; otherwise of all of them alone.

    **Raises:** as `write_tables`.
    """
    return _text(records, study, *all_rows(records, study), groups)


def _text(
    records: Sequence[Record], study: type[Study], results: list[Row], differences: list[Row], groups: bool = True
) -> str:
    sections = [
        underlined(f"{study.title}: {count_of(len(records), 'scene')}"),
        f"{study.explanation}\n"
        f"Mean over scenes +- its standard error, or in percent; in [ ] the {LEVEL:.0%} bootstrap interval over\n"
        f"scenes. ** the best, * the second. Differences: {study.reference} minus another method over the same\n"
        "scenes, * where the interval excludes zero.\n",
    ]
    for group, members in study.groups(records).items():
        if not groups and group != "all":
            continue
        if group != "all":
            sections.append(underlined(f"{group}: {count_of(len(members), 'scene')}"))
        for measure in study.measures:
            title = measure.title.replace("\n", " ")
            here = [row for row in results if (row["group"], row["quantity"]) == (group, measure.name)]
            if measure.listed and here:
                unit = f" ({measure.unit})" if measure.unit else ""
                sections.append(f"{title}{unit}, by {measure.by}\n{_grid(here, 'method', result_text, measure)}")
            here = [row for row in differences if (row["group"], row["quantity"]) == (group, measure.name)]
            if measure.listed and here:
                compared = f"{title}: {study.reference} minus another method"
                sections.append(f"{compared}\n{_grid(here, 'baseline', difference_text, measure)}")
    return "\n".join([*sections, *study.notes(records)])


def _grid(rows: Sequence[Row], key: str, write, measure: Measure) -> str:
    names, columns = (list(dict.fromkeys(row[what] for row in rows)) for what in (key, "at"))
    cells = {(name, str(column)): "-" for name in names for column in columns}
    cells |= {(row[key], str(row["at"])): write(row, measure) for row in rows}
    return text_grid(measure.by, names, [str(column) for column in columns], cells)


def result_text(row: Row, measure: Measure) -> str:
    """A mean over scenes with its error or interval; the best is marked, where one is better than another."""
    mark = _MARKS.get(row["rank"], "  ") if measure.better else ""
    if measure.percent and row["low"] is not None:
        mean, low, high = (100.0 * row[key] for key in ("mean", "low", "high"))
        return f"{mean:3.0f} [{low:3.0f},{high:4.0f}]{mark}"
    if not measure.paired:
        return f"{row['mean']:.{measure.digits}f} ({row['scenes']:3d})"
    error = row["standard_error"]
    error = "" if math.isnan(error) else f" +- {error:.{measure.digits}f}"
    return f"{row['mean']:.{measure.digits}f}{error}{mark}"


def difference_text(row: Row, measure: Measure) -> str:
    """A difference with its interval; marked where that excludes zero."""
    mean, low, high = ((100.0 if measure.percent else 1.0) * row[key] for key in ("mean", "low", "high"))
    form = "+.0f" if measure.percent else f"+.{measure.digits}f"
    return f"{mean:{form}} [{low:{form}}, {high:{form}}]{'*' if row['excludes_zero'] else ' '}"


def tight(text: str) -> str:
    """Without the spaces that align it."""
    return " ".join(text.split()).replace("[ ", "[")


def text_grid(corner: str, rows: Sequence[str], columns: Sequence[str], cells: Mapping[tuple[str, str], str]) -> str:
    """One line for each row, aligned; cells by row and column."""
    width = max(map(len, (*cells.values(), *columns))) + 2
    left = max(map(len, ("." * 13, *rows))) + 2
    head = f"  {corner:{left}}" + "".join(f"{column:>{width}}" for column in columns)
    lines = [f"  {row:{left}}" + "".join(f"{cells[row, column]:>{width}}" for column in columns) for row in rows]
    return "\n".join(line.rstrip() for line in [head, *lines]) + "\n"


def underlined(title: str) -> str:
    """A section's title."""
    return f"{title}\n{'=' * len(title)}\n"


def count_of(count: int, thing: str) -> str:
    """ "1 scene", "2 scenes"."""
    return f"{count} {thing}{'s' if count != 1 else ''}"


def write_csv(path: Path, rows: Sequence[Row], columns: Sequence[str]) -> Path:
    """Write rows under a header of the columns, floats to six digits."""
    lines = io.StringIO(newline="")
    writer = csv.DictWriter(lines, columns)
    writer.writeheader()
    for row in rows:
        writer.writerow({key: round(x, 6) if isinstance(x, float) else x for key, x in row.items()})
    write_text(path, lines.getvalue())
    return path
