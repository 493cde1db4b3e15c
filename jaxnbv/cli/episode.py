"""`jaxnbv demo` and `jaxnbv run MESH`: one episode."""

from pathlib import Path
from types import SimpleNamespace
from typing import Annotated

import typer

from jaxnbv.cli import actions, options
from jaxnbv.cli.registry import DEFAULT_FIRST, Device


def demo(
    task: options.TaskOption = options.CROSS_ENTROPY,
    scene: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Which object: the number of a scene.")] = 0,
    first: Annotated[
        str | None,
        typer.Option(help="Position of the first camera, x,y,z.", show_default="one that does not show the cargo"),
    ] = None,
    search: options.SearchOption = options.HALVING,
    model: options.ModelOption = options.SCREENED,
    known: options.KnownOption = None,
    views: options.ViewsOption = 5,
    until: options.UntilOption = None,
    seed: options.SeedOption = 0,
    out: options.OutOption = None,
    noise: options.NoiseOption = 0.01,
    quick: options.QuickOption = False,
    report: options.ReportOption = True,
    device: options.DeviceOption = Device.AUTO,
) -> None:
    """Find out what a truck carries, which the first view does not show: no file, no network.

    Farthest view, which knows nothing of the task, then starts from the same view. With --task parts the object is a
    procedural one of thirteen categories, with --task heat one of four kinds that is heated at one place, and with
    --task coverage a mug, to be seen all round.
    """
    actions.demo(SimpleNamespace(**locals()))


def run(
    mesh: Annotated[
        Path, typer.Argument(metavar="MESH", help="Any mesh that trimesh reads: OBJ, PLY, STL, OFF, glTF, ...")
    ],
    task: options.TaskOption = options.COVERAGE,
    network: options.NetworkOption = None,
    category: options.CategoryOption = None,
    source: Annotated[
        str | None,
        options.asking(
            metavar="X,Y,Z",
            help="For heat: the point of the object that is heated, in scene units.",
            show_default="the middle of the first view",
        ),
    ] = None,
    first: Annotated[
        str | None,
        options.seeing(
            metavar="X,Y,Z",
            help="Position of the first camera, in scene units; it looks at the origin.",
            show_default=f"from {DEFAULT_FIRST}, as far as the others",
        ),
    ] = None,
    paper: Annotated[
        bool, options.seeing("--paper", help="The paper's close-up: 30 degrees from 2.5 (parts: 2, heat: 3).")
    ] = False,
    fov: Annotated[
        float | None,
        options.seeing(
            metavar="DEGREES",
            min=1.0,
            max=170.0,
            help="Field of view.",
            show_default="30, or what fits the object from --radius",
        ),
    ] = None,
    radius: Annotated[
        float | None,
        options.seeing(
            metavar="X",
            help="Distance of the cameras from the object's centre, in scene units.",
            show_default="the object fits the view",
        ),
    ] = None,
    rays: Annotated[
        int | None,
        options.seeing(
            metavar="N",
            min=4,
            max=1024,
            help="Rays along a side of the image.",
            show_default="50; parts: 64; --quick: 24",
        ),
    ] = None,
    samples: Annotated[
        int | None,
        options.imagining(
            metavar="N", min=1, help="Surfaces that are imagined for each view.", show_default="16; --quick: 4"
        ),
    ] = None,
    candidates: Annotated[
        int | None,
        options.finding(
            metavar="N", min=1, help="Poses among which a view is chosen.", show_default="120; heat: 100; --quick: 40"
        ),
    ] = None,
    lengthscale: Annotated[
        float | None,
        options.imagining(
            metavar="X",
            help="Lengthscale of their detail, a share of 2 pi scene units; longer is smoother.",
            show_default="0.01; --model paper: 0.005",
        ),
    ] = None,
    search: options.SearchOption = options.DISCRETE,
    model: options.ModelOption = options.SCREENED,
    known: options.KnownOption = None,
    views: options.ViewsOption = 5,
    until: options.UntilOption = None,
    seed: options.SeedOption = 0,
    out: options.OutOption = None,
    noise: options.NoiseOption = 0.01,
    quick: options.QuickOption = False,
    report: options.ReportOption = True,
    device: options.DeviceOption = Device.AUTO,
) -> None:
    """Choose views of a mesh, scanned by a simulated depth camera.

    The mesh may be open, a soup of triangles or inconsistently wound. It is scaled and centred so that its longest side
    is 2.5 scene units; cameras stand as far from its centre as it takes to see all of it.
    """
    actions.run(SimpleNamespace(**locals()))
