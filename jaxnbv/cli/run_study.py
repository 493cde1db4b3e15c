"""Run a study of the registry: its scenes, tables, charts and pictures."""

import functools
import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import typer

from jaxnbv.checks import InputError, require
from jaxnbv.cli.registry import resolve
from jaxnbv.storage import describe
from jaxnbv.storage.files import write_bytes, write_text
from jaxnbv.studies.engine.chart import chart
from jaxnbv.studies.engine.pictures import write_pictures
from jaxnbv.studies.engine.records import RecordFolder
from jaxnbv.studies.engine.results import results, summary
from jaxnbv.studies.engine.study import CHART, Factory, Study
from jaxnbv.studies.registry import STUDIES, flag


def run_study(
    name: str,
    scenes: str | None,
    views: int | None,
    methods: str | None,
    own: Sequence[str] | None,
    model: str | None,
    out: Path | None,
    quick: bool,
    workers: int,
    **options: Any,
) -> None:
    """Run a study, or each of those that it consists of, and write what it found.

    - `scenes`, `views`, `model`: None for the study's own; `options`: those of single studies, None where not given.

    **Raises:** `ValueError` for no scenes, unknown methods, an option that the study does not take, or a method of
    one's own that cannot be found; and, once all is written, if scenes failed.
    """
    entry = STUDIES[name]
    given = {option: value for option, value in options.items() if value is not None}
    for option in given:
        takers = ", ".join(other for other, one in STUDIES.items() if option in one.options)
        require(option in entry.options, f"the study {name} takes no {flag(option)}: it is for {takers}")
    require(
        "folder" not in entry.options or "folder" in given,
        f"the study {name} needs a folder: jaxnbv study {name} FOLDER",
    )
    kind: type[Study] = resolve(entry.study)
    model = model or entry.model
    named = None if methods is None else [name.strip() for name in methods.split(",")]
    chosen, added = kind.chosen(named, model), {text: _own(text) for text in own or ()}
    wanted = _scenes(str(entry.scenes) if scenes is None else scenes)
    failed: dict[str, str] = {}
    asked = 0
    of_model = "" if model == entry.model else f"-{model}"
    folder = out or Path("runs") / f"study-{name}{of_model}{'-quick' if quick else ''}"
    if quick:
        typer.echo("--quick: small settings and few scenes. This is not the full study; leave it out for that.")
        wanted = wanted[: kind.quick_scenes]
    for part, settings in kind.configured(model, views or entry.views, quick, **given).items():
        config = {"study": describe(settings), "methods": sorted(chosen)}
        config |= {"own": {text: describe(make) for text, make in added.items()}} if added else {}
        there = wanted if settings.num_scenes is None else [index for index in wanted if index < settings.num_scenes]
        run = functools.partial(settings.run_scene, methods=chosen, own=added)
        held = RecordFolder(folder / part, config, workers)
        records, failures = held.collect(there, run), held.failures(there)
        failed |= {f"{part} scene {index}".strip(): error for index, error in failures.items()}
        asked += len(there)
        if not records:
            continue
        table = results(records, type(settings))
        write_text(folder / part / "results.csv", table.round(6).to_csv(index=False))
        write_bytes(folder / part / CHART, chart(table, type(settings)))
        write_pictures(records, settings, folder / part)
        typer.echo(f"\n{f'{part}. ' if part else ''}{summary(table, type(settings))}")
        typer.echo(f"All tables as CSV, chart and pictures: {folder / part}\n")
    if failed:
        where, error = next(iter(failed.items()))
        raise InputError(
            f"{len(failed)} of {asked} scenes failed, the first {where} ({error}): {folder} has scene_*.failed that "
            "tell how, and the same command tries them again"
        )


def _scenes(asked: str) -> Sequence[int]:
    """The first N, or from A up to but without B."""
    found = re.fullmatch(r"(?:(\d{1,9}):)?(\d{1,9})", asked.strip())
    scenes = range(int(found[1] or 0), int(found[2])) if found else range(0)
    if not scenes:
        raise InputError(f"--scenes {asked} names no scenes: give how many, such as 60, or which, such as 100:130")
    return scenes


def _own(text: str) -> Factory:
    """A function of a module that may lie in the current folder."""
    if (here := os.getcwd()) not in sys.path:
        sys.path.insert(0, here)
    try:
        made = resolve(text)
    # Whatever a module of the user's does as it is imported.
    except (Exception, SystemExit) as error:
        raise InputError(
            f"--method {text} cannot be found ({type(error).__name__}: {error}): write module:function, such as "
            "mine:planner, and start where the module lies"
        ) from error
    require(callable(made), f"--method {text} is a {type(made).__name__}; give a function of a study and a scene")
    return made
