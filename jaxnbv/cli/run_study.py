"""Runs the scenes of `jaxnbv study` and writes tables, a chart and pictures."""

import functools
import os
import re
import sys
from collections.abc import Iterable, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import typer

from jaxnbv.checks import InputError, require
from jaxnbv.cli.registry import resolve
from jaxnbv.cli.study_options import StudyOptions
from jaxnbv.storage import describe
from jaxnbv.storage.files import write_bytes, write_text
from jaxnbv.studies.engine.chart import CHART, chart
from jaxnbv.studies.engine.cluster import Cluster
from jaxnbv.studies.engine.pictures import write_pictures
from jaxnbv.studies.engine.processes import Processes
from jaxnbv.studies.engine.records import RecordFolder
from jaxnbv.studies.engine.results import results, summary
from jaxnbv.studies.engine.run import Factory, methods_of, run_scene
from jaxnbv.studies.engine.study import Study
from jaxnbv.studies.registry import studies


def run_study(name: str, options: StudyOptions, **settings: Any) -> None:
    """Run all parts of a study (for example, one part per framing) and write the results of each part.

    - `settings`: values of the options that only this study has, None where the user gave no value.

    **Raises:** `ValueError` if there are no scenes, a method is unknown, options exclude each other, or a user's method
    cannot be imported. If scenes failed, raises `ValueError` after all results are written.
    """
    entry = studies()[name]
    kind: type[Study] = entry.load()
    is_paper = options.settings == "paper"
    usual_model = "paper" if is_paper else entry.model
    model = options.model or usual_model
    names = None if options.methods is None else [name.strip() for name in options.methods.split(",")]
    methods, own = methods_of(kind, names, model), {text: _import_method(text) for text in options.own or ()}
    default_scenes = kind.quick_scenes if options.quick else entry.scenes
    scenes = _scenes(str(default_scenes) if options.scenes is None else options.scenes)
    changes = f"{'' if model == usual_model else f'-{model}'}{'-paper-settings' if is_paper else ''}"
    folder = options.out or Path("runs") / f"study-{name}{changes}{'-quick' if options.quick else ''}"
    if options.quick:
        typer.echo("--quick: small settings and few scenes. This is not the full study. Leave it out for that.")
    failures: dict[str, str] = {}
    count = 0
    own_settings = {option: value for option, value in settings.items() if value is not None}
    overrides = _overrides(kind, options)
    views = options.views or overrides.pop("views", entry.views)
    studies_by_part = kind.configured(model, views, options.quick, **overrides | own_settings)
    sources = _sources(options.join or (), studies_by_part)
    with _executor(options) as executor:
        for part, study in studies_by_part.items():
            arrays: dict[str, np.ndarray] = {}
            config = {"study": describe(study, arrays, "study"), "methods": sorted(methods)}
            config |= {"own": {text: describe(make) for text, make in own.items()}} if own else {}
            indices = scenes if study.num_scenes is None else [index for index in scenes if index < study.num_scenes]
            run = functools.partial(run_scene, study, methods=methods, own=own)
            results_folder = RecordFolder(folder / part, config, executor, arrays)
            results_folder.join(sources[part])
            records = results_folder.collect(indices, run)
            part_failures = results_folder.failures(indices)
            failures |= {f"{part} scene {index}".strip(): error for index, error in part_failures.items()}
            count += len(indices)
            if records:
                table = results(records, type(study))
                write_text(folder / part / "results.csv", table.round(6).to_csv(index=False))
                write_bytes(folder / part / CHART, chart(table, type(study)))
                write_pictures(records, study, folder / part)
                typer.echo(f"\n{f'{part}. ' if part else ''}{summary(table, type(study))}")
                typer.echo(f"All tables as CSV, chart and pictures: {folder / part}\n")
    if failures:
        where, error = next(iter(failures.items()))
        raise InputError(
            f"{len(failures)} of {count} scenes failed, the first {where} ({error}): scene_*.failed in {folder} "
            "have the reasons, and the same command tries them again"
        )


def _executor(options: StudyOptions) -> AbstractContextManager[Executor | None]:
    """Return a context manager that gives the executor for the scenes, or None to run them in this process."""
    require(
        options.cluster is None or options.workers == 1,
        f"--workers {options.workers} and --cluster {options.cluster} exclude each other: leave one out",
    )
    if options.cluster is not None:
        return Cluster(options.cluster)
    return nullcontext() if options.workers == 1 else Processes(options.workers)


def _sources(folders: Iterable[Path], parts: Iterable[str]) -> dict[str, list[Path]]:
    """Return, for each part of the study, the folders that hold its records.

    - `folders`: output folders of the same study, given by `--join`.
    """
    sources = {part: [folder / part for folder in folders if (folder / part / "study.json").exists()] for part in parts}
    for folder in folders:
        require(
            any(folder / part in sources[part] for part in sources),
            f"--join {folder} holds no records of this study: give folders that the same command wrote (--out)",
        )
    return sources


def _overrides(kind: type[Study], options: StudyOptions) -> dict[str, Any]:
    """Return settings that replace the study's own. Options such as `--grid` take precedence over `--settings`."""
    is_paper = options.settings == "paper"
    require(not (is_paper and options.quick), "--quick and --settings paper exclude each other: leave one out")
    single = {
        "num_candidates": options.candidates,
        "num_samples": options.samples,
        "grid_resolution": options.grid,
        "capacity": options.capacity,
    }
    return (dict(kind.paper) if is_paper else {}) | {name: value for name, value in single.items() if value is not None}


def _scenes(text: str) -> Sequence[int]:
    """Return the indices of scenes: the first N for the text "N", or A to B - 1 for "A:B"."""
    match = re.fullmatch(r"(?:(\d{1,9}):)?(\d{1,9})", text.strip())
    scenes = range(int(match[1] or 0), int(match[2])) if match else range(0)
    if not scenes:
        raise InputError(f"--scenes {text} names no scenes: give how many, such as 60, or which, such as 100:130")
    return scenes


def _import_method(text: str) -> Factory:
    """Import a user's function, given as "module:function". The module may be in the current folder."""
    if (here := os.getcwd()) not in sys.path:
        sys.path.insert(0, here)
    try:
        factory = resolve(text)
    # A user's module can raise any error when it is imported.
    except (Exception, SystemExit) as error:
        raise InputError(
            f"--method {text} cannot be found ({type(error).__name__}: {error}): write module:function, such as "
            "mine:planner, and start in the module's folder"
        ) from error
    require(callable(factory), f"--method {text} is a {type(factory).__name__}; give a function of a study and a scene")
    return factory
