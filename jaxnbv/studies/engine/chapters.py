"""What a folder of finished studies tells: of each its tables, figures, pictures, settings, versions and times."""

import json
import pkgutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jaxnbv.checks import require
from jaxnbv.storage.folders import read_json
from jaxnbv.studies.engine.claims import Verdict, verdicts
from jaxnbv.studies.engine.measures import Measure, Record, Row
from jaxnbv.studies.engine.records import read_records
from jaxnbv.studies.engine.statistics import LEVEL
from jaxnbv.studies.engine.study import Study
from jaxnbv.studies.engine.tables import all_rows, count_of, difference_text, result_text, tight
from jaxnbv.studies.registry import STUDIES

_REMEDY = "give a folder that `jaxnbv study` has written"


class Table(NamedTuple):
    """Cells of text under a header; a row begins with its name.

    - `group`: of the scenes; "" for all of them.
    """

    caption: str
    header: list[str]
    rows: list[list[str]]
    group: str = ""


class Chapter(NamedTuple):
    """One study.

    - `facts`: what was run, in words; `explanation`: what its measures mean.
    - `scenes`: how many; `claims`: what the paper says, and what was found.
    - `images`: figures and pictures, by their captions.
    - `settings`: of the study, as JSON.
    """

    title: str
    scenes: int
    facts: list[str]
    explanation: str
    claims: list[Verdict]
    tables: list[Table]
    images: list[tuple[str, Path]]
    settings: str


def chapters(folder: str | Path) -> list[Chapter]:
    """A chapter for each study in a folder or in folders inside, in the order of the registry.

    **Raises:** `ValueError` if there is none, a study is not known here, or a record is damaged.
    """
    folder = Path(folder)
    require(folder.is_dir(), f"there is no folder {folder}: {_REMEDY}")
    kinds = _kinds()
    found: dict[Path, tuple[int, Chapter]] = {}
    for file in sorted(folder.rglob("study.json")):
        if any(file.parent.glob("scene_*.json")):
            config = read_json(file, "is not a study's record", _REMEDY)
            name = config.get("config", {}).get("study", {}).get("type")
            require(name in kinds, f"{file} is of a study {name!r}, which this version does not know: {_REMEDY}")
            chapter = _chapter(file.parent, file.parent.relative_to(folder), config, kinds[name])
            found[file] = list(kinds).index(name), chapter
    require(len(found) > 0, f"{folder} holds no study that has a scene: {_REMEDY}")
    return [found[file][1] for file in sorted(found, key=lambda file: (found[file][0], file))]


def _kinds() -> dict[str, type[Study]]:
    """The studies by the names of their classes, those of the registry first."""
    named: dict[str, type[Study]] = {}
    for entry in STUDIES.values():
        kind = pkgutil.resolve_name(entry.study)
        named[kind.__qualname__] = kind
    todo = [Study]
    while todo:
        for kind in todo.pop().__subclasses__():
            named.setdefault(kind.__qualname__, kind)
            todo.append(kind)
    return named


def _chapter(path: Path, inside: Path, config: dict[str, Any], kind: type[Study]) -> Chapter:
    records = read_records(path)
    results, differences = all_rows(records, kind)
    tables = []
    for group, members in kind.groups(records).items():
        part = "" if group == "all" else f"{group}: {count_of(len(members), 'scene')}"
        for measure in kind.measures:
            if measure.listed:
                tables += _tables(measure, group, part, results, differences, kind.reference)
    images = [(_caption(file), file) for file in _in_order(path, kind)]
    settings = json.dumps(config.get("config", {}), indent=1)
    where = "" if inside == Path(".") else f": {inside}"
    facts, found = _facts(records, config), verdicts(kind, differences)
    return Chapter(f"{kind.title}{where}", len(records), facts, kind.explanation, found, tables, images, settings)


def _tables(
    measure: Measure, group: str, part: str, results: Sequence[Row], differences: Sequence[Row], reference: str
) -> list[Table]:
    title, unit = measure.title.replace("\n", " "), " in %" if measure.percent else ""
    unit = f" in {measure.unit}" if measure.unit else unit
    made = []
    for rows, key, text, caption in (
        (results, "method", result_text, f"{title}{unit}, by {measure.by}"),
        (differences, "baseline", difference_text, f"{title}{unit}: {reference} minus another method"),
    ):
        here = [row for row in rows if (row["group"], row["quantity"]) == (group, measure.name)]
        if here:
            names, columns = (list(dict.fromkeys(row[what] for row in here)) for what in (key, "at"))
            cells = {(row[key], row["at"]): tight(text(row, measure)) for row in here}
            lines = [[name, *(cells.get((name, column), "") for column in columns)] for name in names]
            made.append(Table(caption, [measure.by, *map(str, columns)], lines, part))
    return made


def _facts(records: Sequence[Record], config: dict[str, Any]) -> list[str]:
    """Scenes, times, and what the numbers were made with."""
    seconds = [record["seconds"] for record in records if "seconds" in record]
    facts = [f"{count_of(len(records), 'scene')}; intervals are the {LEVEL:.0%} bootstrap's, over scenes."]
    if seconds:
        mean = sum(seconds) / len(seconds)
        facts.append(f"{mean:.0f} seconds a scene with all methods, {sum(seconds) / 3600:.2f} hours in all.")
    made_by = config.get("versions") or {}
    if made_by:
        facts.append("Made with " + ", ".join(f"{name} {version}" for name, version in made_by.items()) + ".")
    return facts


def _in_order(path: Path, kind: type[Study]) -> list[Path]:
    """Charts in the study's order, then pictures."""
    charts = [path / f"{name}.png" for name in kind.charts]
    return [*(file for file in charts if file.exists()), *(f for f in sorted(path.glob("*.png")) if f not in charts)]


def _caption(file: Path) -> str:
    return file.stem.replace("_", " ")
