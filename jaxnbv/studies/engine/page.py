"""All studies of a folder on one page: of each its claims, tables, figures, pictures, settings, versions and times."""

import json
import os
import pkgutil
import tempfile
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from jaxnbv.checks import InputError, require
from jaxnbv.storage.files import make_folder, write_text
from jaxnbv.storage.folders import read_record
from jaxnbv.studies.engine.charts import write_charts
from jaxnbv.studies.engine.measures import UNKNOWING, Claim, Record
from jaxnbv.studies.engine.records import RecordFolder, read_records
from jaxnbv.studies.engine.results import LEVEL, results
from jaxnbv.studies.engine.study import Study
from jaxnbv.studies.engine.tables import count_of, difference_text, tables_of
from jaxnbv.studies.registry import STUDIES
from jaxnbv.version import __version__
from jaxnbv.viz.html import render

_REMEDY = "give a folder that `jaxnbv study` has written"
_WHERE = ("ahead of", "level with", "behind")


class Verdict(NamedTuple):
    """A claim, and how the reference fares beside the methods that it names.

    - `against`: by method, "ahead of", "level with" or "behind", and the paired difference with its interval. It is
      level where the interval includes zero.
    """

    claim: Claim
    against: dict[str, tuple[str, str]]

    @property
    def held(self) -> int:
        """Against how many of the methods the claim holds."""
        return sum(where in _WHERE[: 1 if self.claim.ahead else 2] for where, _ in self.against.values())

    @property
    def sentence(self) -> str:
        """What was found, the best first."""
        told = [(where, f"{method} ({text})") for method, (where, text) in self.against.items()]
        parts = [
            f"{where} {', '.join(named)}" for where in _WHERE if (named := [text for at, text in told if at == where])
        ]
        return f"Holds against {self.held} of {len(self.against)}: {'; '.join(parts)}."


class Chapter(NamedTuple):
    """One study.

    - `facts`: what was run, in words; `explanation`: what its measures mean.
    - `scenes`: how many; `claims`: what the paper says, and what was found.
    - `tables`: by the group of scenes, "" for all of them: titles and cells, see `tables_of`.
    - `images`: charts, which are drawn anew, and the pictures that lie in its folder; their names, and PNG files.
    - `settings`: of the study, as JSON.
    """

    title: str
    scenes: int
    facts: list[str]
    explanation: str
    claims: list[Verdict]
    tables: dict[str, list[tuple[str, pd.DataFrame]]]
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
            written = read_record(file, RecordFolder.problem, _REMEDY)
            study = written["config"].get("study")
            name = study.get("type") if isinstance(study, dict) else study
            if not isinstance(name, str) or name not in kinds:
                raise InputError(f"{file} is of a study {name!r}, which this version does not know: {_REMEDY}")
            chapter = _chapter(file.parent, file.parent.relative_to(folder), written, kinds[name])
            found[list(kinds).index(name), file] = chapter
    require(len(found) > 0, f"{folder} holds no study that has a scene: {_REMEDY}")
    return [found[place] for place in sorted(found)]


def verdicts(study: type[Study], differences: pd.DataFrame) -> list[Verdict]:
    """On the claims of which a study's differences over all its scenes tell. Methods that were not run are left out;
    those that know no shapes are held against it too."""
    found = []
    for claim in study.claims:
        measure = study.measure(claim.measure)
        here = differences[(differences["group"] == "all") & (differences["quantity"] == claim.measure)]
        rows = here[here["at"] == claim.at].set_index("baseline")
        named = (f"{method}{way}" for method in claim.than for way in ("", UNKNOWING))
        against = {}
        for method, row in ((method, rows.loc[method]) for method in named if method in rows.index):
            better = (row["mean"] < 0) == (measure.better == "less")
            where = _WHERE[1] if not row["excludes_zero"] else _WHERE[0 if better else 2]
            against[method] = where, difference_text(row, measure).rstrip("*")
        if against:
            found.append(Verdict(claim, against))
    return found


def _kinds() -> dict[str, type[Study]]:
    """The studies by the names of their classes, those of the registry first."""
    named = {kind.__qualname__: kind for kind in (pkgutil.resolve_name(entry.study) for entry in STUDIES.values())}
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
        "" if group == "all" else f"{group}: {count_of(len(members), 'scene')}": tables_of(found, kind, group)
        for group, members in kind.groups(records).items()
    }
    with tempfile.TemporaryDirectory() as own:
        charts = write_charts(records, kind, own)
        pictures = [file for file in sorted(path.glob("*.png")) if file.stem not in kind.charts]
        images = [(file.stem.replace("_", " "), file.read_bytes()) for file in (*charts, *pictures)]
    title = kind.title if inside == Path() else f"{kind.title}: {inside}"
    told = _facts(records, written), kind.explanation, verdicts(kind, found.differences)
    return Chapter(title, len(records), *told, parts, images, json.dumps(written["config"], indent=1))


def _facts(records: Sequence[Record], written: dict[str, Any]) -> list[str]:
    """Scenes, times, and what the numbers were made with."""
    seconds = [record["seconds"] for record in records if "seconds" in record]
    facts = [f"{count_of(len(records), 'scene')}; intervals are the {LEVEL:.0%} bootstrap's, over scenes."]
    if seconds:
        mean = sum(seconds) / len(seconds)
        facts.append(f"{mean:.0f} seconds a scene with all methods, {sum(seconds) / 3600:.2f} hours in all.")
    made_by = written.get("versions")
    if isinstance(made_by, dict) and made_by:
        facts.append("Made with " + ", ".join(f"{name} {version}" for name, version in made_by.items()) + ".")
    return facts
