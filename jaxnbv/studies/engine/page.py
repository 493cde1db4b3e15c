"""All studies of a folder on one page: of each its claims, tables, chart, pictures, settings, versions and times."""

import json
import os
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from jaxnbv.checks import InputError, require
from jaxnbv.storage.files import make_folder, write_text
from jaxnbv.storage.folders import read_record
from jaxnbv.studies.engine.chart import CHART, chart
from jaxnbv.studies.engine.records import read_records
from jaxnbv.studies.engine.results import Verdict, count_of, explained, groups_of, results, tables, verdicts
from jaxnbv.studies.engine.study import Study
from jaxnbv.studies.registry import studies
from jaxnbv.version import __version__
from jaxnbv.viz.html import render

_REMEDY = "give a folder that `jaxnbv study` has written"


class Chapter(NamedTuple):
    """One study.

    - `scenes`: how many; `facts`: what was run, in words; `explanation`: what its measures mean.
    - `tables`: by the group of scenes, each a title and HTML.
    - `images`: its chart, drawn anew, and the pictures that lie in its folder: their names, and PNG files.
    - `settings`: of the study, as JSON.
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
    """Write an HTML page of all studies in a folder, which holds its images and opens offline, and return its path.

    **Raises:** `ValueError` for a name that does not end in .html, and as `chapters` does.
    """
    out = Path(out)
    require(out.suffix == ".html", f"the page {out} must end in .html")
    found, date = chapters(folder), f"{datetime.now(UTC):%Y-%m-%d}"
    make_folder(out.parent)
    write_text(out, render(Path(__file__).with_name("page.html"), chapters=found, version=__version__, date=date))
    return out


def chapters(folder: str | Path) -> list[Chapter]:
    """A chapter for each study in a folder or in folders inside, in the order of the registry.

    **Raises:** `ValueError` if there is none, a study is not known here, or a record is damaged.
    """
    folder = Path(folder)
    require(os.path.isdir(folder), f"there is no folder {folder}: {_REMEDY}")
    kinds = _kinds()
    found: dict[tuple[int, Path], Chapter] = {}
    for file in sorted(folder.rglob("study.json")):
        if any(file.parent.glob("scene_*.json")):
            written = read_record(file.parent, "study", _REMEDY)
            study = written["config"].get("study")
            name = study.get("type") if isinstance(study, dict) else study
            name = name.rpartition(":")[2] if isinstance(name, str) else name
            if not isinstance(name, str) or name not in kinds:
                raise InputError(f"{file} is of a study {name!r}, which this version does not know: {_REMEDY}")
            chapter = _chapter(file.parent, file.parent.relative_to(folder), written, kinds[name])
            found[list(kinds).index(name), file] = chapter
    require(len(found) > 0, f"{folder} holds no study that has a scene: {_REMEDY}")
    return [found[place] for place in sorted(found)]


def _kinds() -> dict[str, type[Study]]:
    """The studies by the names of their classes, those of the registry first."""
    named = {kind.__qualname__: kind for kind in (entry.load() for entry in studies().values())}
    todo = [Study]
    while todo:
        for kind in todo.pop().__subclasses__():
            named.setdefault(kind.__qualname__, kind)
            todo.append(kind)
    return named


def _chapter(path: Path, inside: Path, written: dict[str, Any], kind: type[Study]) -> Chapter:
    records = read_records(path)
    found = results(records, kind)
    parts = {
        f"{group}: {count_of(scenes, 'scene')}": [
            (title, cells.to_html(border=0)) for title, cells in tables(found, kind, group)
        ]
        for group, scenes in groups_of(found).items()
    }
    images = [(CHART, chart(found, kind))]
    images += [(file.stem, file.read_bytes()) for file in sorted(path.glob("*.png")) if file.name != CHART]
    seconds = sum(record["seconds"] for record in records)
    made_by = ", ".join(f"{name} {version}" for name, version in written.get("versions", {}).items())
    facts = [
        f"{seconds / len(records):.0f} seconds a scene with all methods, {seconds / 3600:.2f} hours in all.",
        f"Made with {made_by}.",
    ]
    title = kind.title if inside == Path() else f"{kind.title}: {inside}"
    told = f"{kind.explanation} {explained(kind)}", verdicts(found, kind), parts, images
    return Chapter(title, len(records), facts, *told, json.dumps(written["config"], indent=1))
