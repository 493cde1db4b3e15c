"""Options of `jaxnbv study` that all studies take."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from jaxnbv.cli.options import one_of, planner_option, run_option
from jaxnbv.cli.registry import STUDY_MODELS, STUDY_SETTINGS

_size_option = partial(planner_option, show_default="that of the settings")


@dataclass(frozen=True, kw_only=True)
class StudyOptions:
    scenes: Annotated[
        str | None,
        typer.Option(
            metavar="N|A:B",
            help="Scenes of the test split: the first N, or A to B - 1.",
            show_default="the study's number of scenes",
        ),
    ] = None
    views: Annotated[
        int | None, typer.Option(min=2, help="Number of views, including the first.", show_default="the study's")
    ] = None
    methods: Annotated[
        str | None,
        typer.Option(help="Methods to run, separated by commas.", show_default="the methods of the study's tables"),
    ] = None
    own: Annotated[
        list[str] | None,
        typer.Option(
            "--method",
            help="A method of your own for the same table, module:function. The function makes a Planner from the "
            "study and one of its scenes. The module may be in the current folder. Can be repeated.",
            show_default=False,
        ),
    ] = None
    settings: Annotated[
        str, planner_option(**one_of(STUDY_SETTINGS, "SETTINGS", "Settings of the planner and number of views."))
    ] = "usual"
    candidates: Annotated[int | None, _size_option(min=2, help="Number of candidate poses.")] = None
    samples: Annotated[int | None, _size_option(min=1, help="Number of posterior samples.")] = None
    grid: Annotated[int | None, _size_option(min=2, help="Nodes of the samples' grid along each axis.")] = None
    capacity: Annotated[int | None, _size_option(min=1, help="Number of points to keep in the cloud.")] = None
    model: Annotated[
        str | None,
        planner_option(
            **one_of(STUDY_MODELS, "MODEL", "Model of the imagined surfaces."),
            show_default="known if the study has known shapes; with --settings paper: paper",
        ),
    ] = None
    out: Annotated[
        Path | None,
        run_option(
            help="Output folder. Scenes that it already has are not run again.",
            show_default="runs/study-NAME[-MODEL][-quick]; with --settings paper: runs/study-NAME-paper-settings",
        ),
    ] = None
    quick: Annotated[
        bool, run_option("--quick", help="Small settings and few scenes. Takes minutes, and is not the full study.")
    ] = False
    workers: Annotated[
        int, run_option(min=1, help="Number of processes, which run one scene each at a time and share the cores.")
    ] = 1
    cluster: Annotated[
        str | None,
        run_option(
            metavar="tcp://HOST:PORT",
            help="Address of a Dask scheduler. Its workers run the scenes, and this process writes the records.",
            show_default=False,
        ),
    ] = None
    join: Annotated[
        list[Path] | None,
        run_option(
            metavar="FOLDER...",
            help="Output folders of the same study. Their records are first copied into this run's folder.",
            show_default=False,
        ),
    ] = None
