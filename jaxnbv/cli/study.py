"""`jaxnbv study ...`: the runs behind the paper's tables and figures."""

import dataclasses
import functools
from pathlib import Path
from typing import Annotated

import typer

from jaxnbv.checks import require
from jaxnbv.cli.options import Device, DeviceOption, prepare
from jaxnbv.datasets import Framing
from jaxnbv.experiments.pyramid_figures import write_figures
from jaxnbv.experiments.pyramid_pictures import write_pictures
from jaxnbv.experiments.pyramid_report import summary_table, write_tables
from jaxnbv.experiments.pyramid_study import METHODS, PyramidStudy, run_scene
from jaxnbv.experiments.records import RecordFolder
from jaxnbv.networks import pyramid_classifier
from jaxnbv.storage import describe
from jaxnbv.surfaces import GeometricSPSR

study = typer.Typer(
    help="Measure the paper's claims on many scenes.", no_args_is_help=True, rich_markup_mode="markdown"
)


@study.callback()
def _studies() -> None:
    """Measure the paper's claims on many scenes, with the same scenes, first views and noise for all methods."""


@study.command()
def pyramid(
    scenes: Annotated[int, typer.Option(min=1, help="Scenes of the test split.")] = 100,
    views: Annotated[int, typer.Option(min=2, help="Views in all, the first one included.")] = 5,
    framing: Annotated[
        Framing | None,
        typer.Option(
            help="How large the object stands: a view shows a patch of it, or nearly all.", show_default="both"
        ),
    ] = None,
    methods: Annotated[str, typer.Option(help="Which methods, separated by commas.")] = ",".join(METHODS),
    out: Annotated[
        Path | None,
        typer.Option(
            help="Output folder; the scenes already in it are not run again.", show_default="runs/study-pyramid[-quick]"
        ),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Small settings and at most 6 scenes: minutes, and not the full study.")
    ] = False,
    device: DeviceOption = Device.AUTO,
) -> None:
    """Which methods find the pattern on a pyramid's base, and how soon is its class known?

    Writes a record a scene, tables as text and CSV, and figures. Interrupted, it continues with the next scene.

    48 candidates, 16 samples of a Gaussian process that fits the spacing of the data (lengthscale 0.01, L = 32) on a
    64^3 grid, and 512 points for the classifier of imagined scans: fewer candidates and a smoother prior than the
    paper's.
    """
    prepare(device)
    asked = {name.strip() for name in methods.split(",")}
    names = tuple(name for name in METHODS if name in asked)
    unknown = sorted(asked - {*METHODS})
    require(not unknown, f"unknown methods: {', '.join(unknown)}; choose from {', '.join(METHODS)}")
    if quick:
        typer.echo("--quick: small settings and few scenes. This is not the full study; leave it out for that.")
    for one in Framing if framing is None else (framing,):
        settings = _settings(one, views, quick)
        folder = (out or Path("runs") / f"study-pyramid{'-quick' if quick else ''}") / one.value
        config = {"study": describe(settings), "methods": sorted(names)}
        records = RecordFolder(folder, config).collect(
            min(scenes, 6) if quick else scenes, functools.partial(run_scene, settings, methods=names)
        )
        write_tables(records, folder)
        write_figures(records, folder)
        write_pictures(records, one, folder)
        typer.echo(f"\n{summary_table(records, by_angle=False)}")
        typer.echo(f"by the angle of the first view, CSV files and figures: {folder}\n")


def _settings(framing: Framing, views: int, quick: bool) -> PyramidStudy:
    classifier = pyramid_classifier(framing.longest_side)
    imagining = pyramid_classifier(framing.longest_side, num_points=512)
    settings = PyramidStudy(classifier, framing, views=views, imagining=imagining)
    if not quick:
        return settings
    model = GeometricSPSR(lengthscale=0.02, truncation=16)
    return dataclasses.replace(settings, model=model, num_candidates=40, num_samples=4, grid_resolution=48)
