"""HTML page with the claims, tables, chart, pictures, settings and times of all studies in a folder."""

import json
import os
from collections import Counter
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from jaxnbv.checks import InputError, require
from jaxnbv.storage.files import make_folder, write_text
from jaxnbv.storage.folders import read_record
from jaxnbv.studies.engine.chart import CHART, chart
from jaxnbv.studies.engine.records import read_records
from jaxnbv.studies.engine.results import Verdict, groups_of, results, table_legend, tables, verdicts, with_plural
from jaxnbv.studies.engine.study import Study
from jaxnbv.studies.registry import studies
from jaxnbv.version import __version__
from jaxnbv.viz.html import render

_REMEDY = "give a folder that `jaxnbv study` has written"


class Chapter(NamedTuple):
    """The section about one study on the HTML page.

    - `scenes`: number of scenes; `facts`: sentences on times and versions.
    - `explanation`: text about the measures and the cells of the tables.
    - `tables`: titles and HTML of the tables, for each group of scenes.
    - `images`: names and PNG content of the chart, drawn from the records, and of the pictures in the study's folder.
    - `settings`: settings of the study as JSON.
    """

    title: str
    scenes: int
    facts: list[str]
    explanation: str
    verdicts: list[Verdict]
    tables: dict[str, list[tuple[str, str]]]
    images: list[tuple[str, bytes]]
    settings: str


def write_page(folder: str | Path, out: str | Path) -> Path:
    """Write all studies in a folder to one HTML page, which needs no other files, and return its path.

    **Raises:** `ValueError` if the name of the page does not end in .html, and whenever `chapters` raises it.
    """
    out = Path(out)
    require(out.suffix == ".html", f"the page {out} must end in .html")
    content, date = chapters(folder), f"{datetime.now(UTC):%Y-%m-%d}"
    make_folder(out.parent)
    write_text(out, render(Path(__file__).with_name("page.html"), chapters=content, version=__version__, date=date))
    return out


def chapters(folder: str | Path) -> list[Chapter]:
    """Return one chapter for each study in a folder and its subfolders, in the order of the registry.

    **Raises:** `ValueError` if there is no study, if this version does not know a study, or if a record is damaged.
    """
    folder = Path(folder)
    require(os.path.isdir(folder), f"there is no folder {folder}: {_REMEDY}")
    kinds = _kinds()
    records: dict[tuple[int, Path], tuple[dict[str, Any], type[Study]]] = {}
    for file in sorted(folder.rglob("study.json")):
        if any(file.parent.glob("scene_*.json")):
            record = read_record(file.parent, "study", _REMEDY)
            study = record["config"].get("study")
            name = study.get("type") if isinstance(study, dict) else study
            name = name.rpartition(":")[2] if isinstance(name, str) else name
            if not isinstance(name, str) or name not in kinds:
                raise InputError(f"{file} belongs to the study {name!r}, which this version does not know: {_REMEDY}")
            records[list(kinds).index(name), file.parent] = record, kinds[name]
    require(len(records) > 0, f"{folder} holds no study that has a scene: {_REMEDY}")
    counts = Counter(index for index, _ in records)
    return [
        _chapter(path, str(path.relative_to(folder)) if counts[index] > 1 else "", *records[index, path])
        for index, path in sorted(records)
    ]


def _kinds() -> dict[str, type[Study]]:
    """Return the classes of studies by name: those of the registry, then other subclasses of `Study`."""
    kinds = {kind.__qualname__: kind for kind in (entry.load() for entry in studies().values())}
    todo = [Study]
    while todo:
        for kind in todo.pop().__subclasses__():
            kinds.setdefault(kind.__qualname__, kind)
            todo.append(kind)
    return kinds


def _chapter(path: Path, name: str, record: dict[str, Any], kind: type[Study]) -> Chapter:
    """Return the chapter of the study in the folder `path`.

    `name` tells studies of one class apart. It is empty if there is only one.
    """
    records = read_records(path)
    table = results(records, kind)
    parts: dict[str, list[tuple[str, str]]] = {}
    for group, scenes in groups_of(table).items():
        texts = [(title, cells.to_html(border=0)) for title, cells in tables(table, kind, group)]
        parts[f"{group}: {with_plural(scenes, 'scene')}"] = texts
    images = [(CHART, chart(table, kind))]
    images += [(file.stem, file.read_bytes()) for file in sorted(path.glob("*.png")) if file.name != CHART]
    seconds = sum(scene["seconds"] for scene in records)
    versions_text = ", ".join(f"{name} {version}" for name, version in record.get("versions", {}).items())
    facts = [
        f"{seconds / len(records):.0f} seconds per scene with all methods, {seconds / 3600:.2f} hours in all.",
        f"Made with {versions_text}.",
    ]
    title = f"{kind.title}: {name}" if name else kind.title
    body = f"{kind.explanation} {table_legend(kind)}", verdicts(table, kind), parts, images
    return Chapter(title, len(records), facts, *body, json.dumps(record["config"], indent=1))
