"""`jaxnbv study ...`: the runs behind the paper's tables and figures."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from jaxnbv.cli import actions
from jaxnbv.cli.options import Device, DeviceOption, ModelOption
from jaxnbv.datasets import Framing
from jaxnbv.errors import InputError
from jaxnbv.model_name import ModelName

study = typer.Typer(
    help="Measure the paper's claims on many scenes.", no_args_is_help=True, rich_markup_mode="markdown"
)

ScenesOption = Annotated[int, typer.Option(min=1, help="Scenes of the test split.")]
ViewsOption = Annotated[int, typer.Option(min=2, help="Views in all, the first one included.")]
MethodsOption = Annotated[
    str | None, typer.Option(help="Which methods, separated by commas.", show_default="all of the table")
]
QuickOption = Annotated[
    bool, typer.Option("--quick", help="Small settings and few scenes: minutes, and not the full study.")
]
FolderOption = Annotated[
    Path | None,
    typer.Option(
        "--out",
        help="Output folder; the scenes already in it are not run again.",
        show_default="runs/study-NAME[-paper][-quick]",
    ),
]
MeshesOption = Annotated[
    Path | None, typer.Option(help="A folder of meshes to scan.", show_default="procedural objects")
]
# What the quick settings of all studies have in common.
_QUICK: dict[str, Any] = {
    "num_samples": 4,
    "grid_resolution": 48,
    "capacity": 1024,
}


@study.callback()
def _studies() -> None:
    """Measure the paper's claims on many scenes, with the same scenes, first views and noise for all methods."""


@study.command()
def pyramid(
    scenes: ScenesOption = 100,
    views: ViewsOption = 5,
    framing: Annotated[
        Framing | None,
        typer.Option(
            help="How large the object stands: a view shows a patch of it, or nearly all.", show_default="both"
        ),
    ] = None,
    methods: MethodsOption = None,
    model: ModelOption = ModelName.SCREENED,
    out: FolderOption = None,
    quick: QuickOption = False,
    device: DeviceOption = Device.AUTO,
) -> None:
    """Which methods find the pattern on a pyramid's base, and how soon is its class known?

    Writes a record a scene, tables as text and CSV, and figures. Interrupted, it continues with the next scene.

    48 candidates, 16 samples on a 64^3 grid, and 512 points for the classifier of imagined scans: fewer
    candidates and a coarser grid than the paper's.
    """
    actions.prepare(device)
    studies = actions.studies
    names = _methods(methods, studies.pyramid_study.METHODS)
    for one in Framing if framing is None else (framing,):
        classifier = studies.pyramid_classifier(one.longest_side)
        imagining = studies.pyramid_classifier(one.longest_side, num_points=512)
        settings = studies.pyramid_study.PyramidStudy(
            classifier, one, *studies.imagination(model, one.longest_side, quick), views=views, imagining=imagining
        )
        settings = dataclasses.replace(settings, **_QUICK, num_candidates=40) if quick else settings
        folder = _folder(out, "pyramid", model, quick) / one.value
        records = _collect(
            studies.pyramid_study.run_scene, settings, names, min(scenes, 6) if quick else scenes, folder, quick
        )
        studies.pyramid_report.write_tables(records, folder)
        studies.pyramid_figures.write_figures(records, folder)
        studies.pyramid_pictures.write_pictures(records, one, folder)
        typer.echo(f"\n{studies.pyramid_report.summary_table(records, by_angle=False)}")
        typer.echo(f"by the angle of the first view, CSV files and figures: {folder}\n")


@study.command()
def parts(
    scenes: ScenesOption = 80,
    views: ViewsOption = 6,
    methods: MethodsOption = None,
    model: ModelOption = ModelName.SCREENED,
    out: FolderOption = None,
    quick: QuickOption = False,
    device: DeviceOption = Device.AUTO,
) -> None:
    """How many views until all parts of an object are found? The paper's Table 1, on procedural objects.

    Writes a record a scene, tables as text and CSV, figures and pictures. Interrupted, it continues with the next
    scene.

    48 candidates at radius 2, 64 x 64 rays. Views are imagined with 32 x 32 rays, 8 samples on a 64^3 grid, and 1,024
    points for the segmenter, 2,048 for what it says of the cloud; gradient search climbs from the best 4 of 24 views, 8
    steps of 0.03: less of everything than the paper.
    """
    actions.prepare(device)
    studies = actions.studies
    settings = studies.part_study.PartStudy(studies.part_segmenter(category=0), views=views, **_surfaces(model, quick))
    if quick:
        settings = dataclasses.replace(
            settings, **_QUICK, num_candidates=24, num_points=512, num_starts=2, iterations=4
        )
    folder = _folder(out, "parts", model, quick)
    names = _methods(methods, studies.part_study.METHODS)
    records = _collect(
        studies.part_study.run_scene, settings, names, min(scenes, 4) if quick else scenes, folder, quick
    )
    _write(records, settings, folder, studies.part_report, studies.part_figures, studies.part_pictures)


@study.command()
def heat(
    scenes: ScenesOption = 24,
    views: ViewsOption = 6,
    methods: MethodsOption = None,
    model: ModelOption = ModelName.SCREENED,
    meshes: MeshesOption = None,
    out: FolderOption = None,
    quick: QuickOption = False,
    device: DeviceOption = Device.AUTO,
) -> None:
    """How near does the coldest point of the scanned cloud come to the object's?

    On procedural objects whose coldest point hides, or on your meshes, heated at one place. Writes a record a scene,
    tables as text and CSV, figures and pictures. Interrupted, it continues with the next scene.

    32 candidates at radius 3, 50 x 50 rays. Views are imagined with 24 x 24 rays, 8 samples on a 64^3 grid, and added
    to 1,024 points of the cloud: less of everything than the paper.
    """
    actions.prepare(device)
    studies = actions.studies
    files = () if meshes is None else studies.mesh_files(meshes)
    settings = studies.heat_study.HeatStudy(files, views=views, **_surfaces(model, quick))
    scenes = min(scenes, len(files)) if files else scenes
    if quick:
        settings = dataclasses.replace(settings, **_QUICK, num_candidates=24, num_points=512)
    folder = _folder(out, "heat", model, quick)
    names = _methods(methods, studies.heat_study.METHODS)
    records = _collect(
        studies.heat_study.run_scene, settings, names, min(scenes, 3) if quick else scenes, folder, quick
    )
    _write(records, settings, folder, studies.heat_report, studies.heat_figures, studies.heat_pictures)


@study.command()
def reconstruction(
    scenes: ScenesOption = 32,
    views: ViewsOption = 5,
    methods: MethodsOption = None,
    model: ModelOption = ModelName.SCREENED,
    meshes: MeshesOption = None,
    out: FolderOption = None,
    quick: QuickOption = False,
    device: DeviceOption = Device.AUTO,
) -> None:
    """How near is the surface that a method's views give to the true one? The table of the paper's supplement.

    Writes a record a scene, tables as text and CSV, figures and pictures. Interrupted, it continues with the next
    scene.

    48 candidates, 16 samples on a 64^3 grid: fewer and coarser than the paper's.
    """
    actions.prepare(device)
    studies = actions.studies
    files = () if meshes is None else studies.mesh_files(meshes)
    settings = studies.reconstruction_study.ReconstructionStudy(files, views=views, **_surfaces(model, quick))
    settings = dataclasses.replace(settings, **_QUICK, num_candidates=40) if quick else settings
    scenes = min(scenes, len(files)) if files else scenes
    folder = _folder(out, "reconstruction", model, quick)
    names = _methods(methods, studies.reconstruction_study.METHODS)
    run = studies.reconstruction_study.run_scene
    records = _collect(run, settings, names, min(scenes, 4) if quick else scenes, folder, quick)
    _write(
        records,
        settings,
        folder,
        studies.reconstruction_report,
        studies.reconstruction_figures,
        studies.reconstruction_pictures,
    )


def _surfaces(model: ModelName, quick: bool) -> dict[str, Any]:
    return actions.studies.imagination(model, quick=quick)._asdict()


def _methods(asked: str | None, known: Sequence[str]) -> tuple[str, ...]:
    if asked is None:
        return tuple(known)
    names = {name.strip() for name in asked.split(",")}
    unknown = sorted(names - {*known})
    if unknown:
        raise InputError(f"unknown methods: {', '.join(unknown)}; choose from {', '.join(known)}")
    return tuple(name for name in known if name in names)


def _folder(out: Path | None, name: str, model: ModelName, quick: bool) -> Path:
    of_model = "" if model is ModelName.SCREENED else f"-{model}"
    return out or Path("runs") / f"study-{name}{of_model}{'-quick' if quick else ''}"


def _collect(
    run_scene: Callable[..., dict], settings: Any, methods: Sequence[str], scenes: int, folder: Path, quick: bool
) -> list[dict]:
    """The records of the scenes: those in the folder as they are, the others as they are run."""
    if quick:
        typer.echo("--quick: small settings and few scenes. This is not the full study; leave it out for that.")
    config = {"study": actions.studies.describe(settings), "methods": sorted(methods)}
    return actions.studies.RecordFolder(folder, config).collect(
        scenes, functools.partial(run_scene, settings, methods=methods)
    )


def _write(records: list[dict], settings: Any, folder: Path, report: Any, figures: Any, pictures: Any) -> None:
    """Tables, figures and pictures of a study, by the modules that make them."""
    report.write_tables(records, folder)
    figures.write_figures(records, folder)
    pictures.write_pictures(records, settings, folder)
    typer.echo(f"\n{report.summary_table(records)}")
    typer.echo(f"CSV files, figures and pictures: {folder}\n")
