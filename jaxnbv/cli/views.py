"""`jaxnbv demo` and `jaxnbv run MESH`: one episode."""

from pathlib import Path
from typing import Annotated

import typer

from jaxnbv.cli import actions
from jaxnbv.cli.options import (
    DEFAULT_FIRST,
    CategoryOption,
    Device,
    DeviceOption,
    EpisodeOptions,
    FirstOption,
    FramingOption,
    ModelOption,
    NoiseOption,
    OutOption,
    QuickOption,
    ReportOption,
    SearchName,
    SearchOption,
    SeedOption,
    SourceOption,
    Task,
    TaskOption,
    ViewsOption,
)
from jaxnbv.datasets import Framing
from jaxnbv.model_name import ModelName


def demo(
    task: TaskOption = Task.CROSS_ENTROPY,
    search: SearchOption = SearchName.DISCRETE,
    model: ModelOption = ModelName.SCREENED,
    views: ViewsOption = 5,
    scene: Annotated[int, typer.Option(min=0, help="Which object: the number of a scene.")] = 0,
    framing: FramingOption = Framing.WHOLE,
    first: Annotated[
        str | None,
        typer.Option(help="Position of the first camera, x,y,z.", show_default="one that hides the pattern"),
    ] = None,
    seed: SeedOption = 0,
    out: OutOption = None,
    noise: NoiseOption = 0.01,
    quick: QuickOption = False,
    report: ReportOption = True,
    device: DeviceOption = Device.AUTO,
) -> None:
    """Find out which pattern is pressed into the base of a pyramid: no file, no network.

    The first view does not show the pattern. The pyramid is small enough for a view to see nearly all of its near side;
    with --framing close-up a view shows a patch of it. With --task parts the object is a procedural one of thirteen
    categories, with --task heat one of four kinds that is heated at one place, and with --task coverage a laid tea mug,
    to be seen all round.
    """
    actions.prepare(device)
    options = EpisodeOptions(search, model, views, seed, out, noise, quick, report)
    actions.demo(task, scene, framing, first, options)


def run(
    mesh: Annotated[
        Path, typer.Argument(metavar="MESH", help="Any mesh that trimesh reads: OBJ, PLY, STL, OFF, glTF, ...")
    ],
    task: TaskOption = Task.COVERAGE,
    network: Annotated[
        Path | None,
        typer.Option(
            help="A PointNet++ network, .pth or .safetensors: a classifier for the tasks that are about the class, "
            "which need one; for parts a part segmenter, in place of the one that ships."
        ),
    ] = None,
    category: CategoryOption = None,
    source: SourceOption = None,
    search: SearchOption = SearchName.DISCRETE,
    model: ModelOption = ModelName.SCREENED,
    views: ViewsOption = 5,
    first: FirstOption = DEFAULT_FIRST,
    seed: SeedOption = 0,
    out: OutOption = None,
    noise: NoiseOption = 0.01,
    quick: QuickOption = False,
    report: ReportOption = True,
    device: DeviceOption = Device.AUTO,
) -> None:
    """Choose views of a mesh, scanned by a simulated depth camera.

    The mesh may be open, a soup of triangles or inconsistently wound. It is scaled and centred so that its longest side
    is 2.5 scene units; cameras stand 2.5 from its centre.
    """
    actions.prepare(device)
    options = EpisodeOptions(search, model, views, seed, out, noise, quick, report)
    actions.run(mesh, task, network, category, source, first, options)
