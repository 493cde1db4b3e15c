"""Results of a study as text, and as CSV with one row a number."""

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from jaxnbv.storage.files import make_folder, write_text
from jaxnbv.studies.engine.measures import Measure, Record
from jaxnbv.studies.engine.results import LEVEL, Results, results
from jaxnbv.studies.engine.study import Study

_MARKS = {1: "**", 2: "*"}


def write_tables(records: Sequence[Record], study: type[Study], folder: str | Path) -> list[Path]:
    """Write the tables of a study into a folder, and return their paths: `results.txt`, the text of `summary`, and
    with one row a number `results.csv` and `differences.csv`.

    **Raises:** as `results`.
    """
    folder, found = make_folder(folder), results(records, study)
    texts = {
        "results.txt": summary(records, study, found=found),
        "results.csv": found.means.round(6).to_csv(index=False),
        "differences.csv": found.differences.round(6).to_csv(index=False),
    }
    for name, text in texts.items():
        write_text(folder / name, text)
    return [folder / name for name in texts]


def summary(records: Sequence[Record], study: type[Study], groups: bool = True, found: Results | None = None) -> str:
    """A study as text: its measures by method, and differences to its reference.

    - `groups`: of each group of its scenes; otherwise of all of them alone.
    - `found`: the results, where they are known.

    **Raises:** as `results`.
    """
    found = found or results(records, study)
    sections = [
        _underlined(f"{study.title}: {count_of(len(records), 'scene')}"),
        f"{study.explanation}\n"
        f"Mean over scenes +- its standard error, or in percent; in [ ] the {LEVEL:.0%} bootstrap interval over\n"
        f"scenes. ** the best, * the second. Differences: {study.reference} minus another method over the same\n"
        "scenes, * where the interval excludes zero.\n",
    ]
    for group, members in study.groups(records).items() if groups else [("all", records)]:
        if group != "all":
            sections.append(_underlined(f"{group}: {count_of(len(members), 'scene')}"))
        sections += [f"{title}\n{cells.to_string()}\n" for title, cells in tables_of(found, study, group)]
    return "\n".join(sections)


def tables_of(found: Results, study: type[Study], group: str) -> list[tuple[str, pd.DataFrame]]:
    """The measures that are listed and their differences, each a title and cells of text: a row a method."""
    made = []
    for measure in (measure for measure in study.measures if measure.listed):
        title, unit = measure.title.replace("\n", " "), "%" if measure.percent else measure.unit
        unit = f" ({unit})" if unit else ""
        for of, key, text, caption in (
            (found.means, "method", result_text, f"{title}{unit}, by {measure.by}"),
            (found.differences, "baseline", difference_text, f"{title}{unit}: {study.reference} minus another method"),
        ):
            here = of[(of["group"] == group) & (of["quantity"] == measure.name)]
            if len(here):
                texts = [text(row, measure) for _, row in here.iterrows()]
                cells = here.assign(text=texts).pivot(index=key, columns="at", values="text")
                ordered = cells.reindex(index=here[key].unique(), columns=here["at"].unique()).fillna("-")
                made.append((caption, ordered.rename_axis(index=None, columns=measure.by)))
    return made


def result_text(row: pd.Series, measure: Measure) -> str:
    """A mean over scenes with its error or interval; the best is marked, where one is better than another."""
    mark = "" if pd.isna(row["rank"]) else _MARKS.get(row["rank"], "")
    if not measure.paired:
        return f"{row['mean']:.{measure.digits}f} ({row['scenes']})"
    if measure.percent:
        return "{:.0f} [{:.0f}, {:.0f}]".format(*(100.0 * row[["mean", "low", "high"]])) + mark
    error = row["standard_error"]
    error = "" if pd.isna(error) else f" +- {error:.{measure.digits}f}"
    return f"{row['mean']:.{measure.digits}f}{error}{mark}"


def difference_text(row: pd.Series, measure: Measure) -> str:
    """A difference with its interval; marked where that excludes zero."""
    form = "+.0f" if measure.percent else f"+.{measure.digits}f"
    mean, low, high = (f"{(100.0 if measure.percent else 1.0) * row[key]:{form}}" for key in ("mean", "low", "high"))
    return f"{mean} [{low}, {high}]{'*' if row['excludes_zero'] else ''}"


def count_of(count: int, thing: str) -> str:
    """ "1 scene", "2 scenes"."""
    return f"{count} {thing}{'s' if count != 1 else ''}"


def _underlined(title: str) -> str:
    return f"{title}\n{'=' * len(title)}\n"
