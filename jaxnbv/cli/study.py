"""`jaxnbv study ...`: the runs behind the paper's tables and figures."""

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
        typer.Option(help="How large the object stands: a view shows a patch of it, or all.", show_default="both"),
    ] = None,
    methods: Annotated[str, typer.Option(help="Which methods, separated by commas.")] = ",".join(METHODS),
    out: Annotated[Path, typer.Option(help="Output folder; the scenes already in it are not run again.")] = Path(
        "runs/study-pyramid"
    ),
    quick: Annotated[
        bool, typer.Option("--quick", help="Small settings and at most 6 scenes: minutes, and not the full study.")
    ] = False,
    device: DeviceOption = Device.AUTO,
) -> None:
    """Which methods find the pattern on a pyramid's base, and how soon is its class known?

    Writes a record a scene, tables as text and CSV, and figures. Interrupted, it continues with the next scene.
    """
    prepare(device)
    names = tuple(name.strip() for name in methods.split(","))
    unknown = [name for name in names if name not in METHODS]
    require(not unknown, f"unknown methods: {', '.join(unknown)}; choose from {', '.join(METHODS)}")
    if quick:
        typer.echo("--quick: small settings and few scenes. This is not the full study; leave it out for that.")
    for one in Framing if framing is None else (framing,):
        settings = _settings(one, views, quick)
        folder = out / one.value
        config = {"study": describe(settings), "methods": list(names)}
        records = RecordFolder(folder, config).collect(
            min(scenes, 6) if quick else scenes, functools.partial(run_scene, settings, methods=names)
        )
        write_tables(records, folder)
        write_figures(records, folder)
        write_pictures(records, one, folder)
        typer.echo(f"\n{one.value}\n{summary_table(records)}\nresults  {folder}")


def _settings(framing: Framing, views: int, quick: bool) -> PyramidStudy:
    classifier = pyramid_classifier(framing.longest_side)
    imagining = pyramid_classifier(framing.longest_side, num_points=512)
    if not quick:
        return PyramidStudy(classifier, framing, views=views, imagining=imagining)
    model = GeometricSPSR(lengthscale=0.02, truncation=16)
    return PyramidStudy(
        classifier, framing, views=views, num_candidates=40, num_samples=4, model=model, grid_resolution=48
    )
