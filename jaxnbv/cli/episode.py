"""`jaxnbv demo` and `jaxnbv run MESH`: one episode."""

from pathlib import Path
from types import SimpleNamespace
from typing import Annotated

import typer

from jaxnbv.cli import actions, options
from jaxnbv.cli.registry import Device

MeshArgument = Annotated[
    Path, typer.Argument(metavar="MESH", help="Any mesh that trimesh reads: OBJ, PLY, STL, OFF, glTF, ...")
]
SceneOption = Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Which object: the number of a scene.")]
HidingFirstOption = Annotated[
    str | None,
    typer.Option(help="Position of the first camera, x,y,z.", show_default="one that does not show the cargo"),
]


def demo(
    task: options.TaskOption = options.CROSS_ENTROPY,
    scene: SceneOption = 0,
    first: HidingFirstOption = None,
    search: options.SearchOption = options.HALVING,
    model: options.ModelOption = options.SCREENED,
    known: options.KnownOption = None,
    views: options.ViewsOption = 5,
    until: options.UntilOption = None,
    seed: options.SeedOption = 0,
    out: options.OutOption = None,
    overwrite: options.OverwriteOption = False,
    noise: options.NoiseOption = 0.01,
    quick: options.QuickOption = False,
    report: options.ReportOption = True,
    device: options.DeviceOption = Device.AUTO,
) -> None:
    """Find out what a truck carries, which the first view does not show: no file, no network.

    Farthest view, which knows nothing of the task, then starts from the same view. With --task parts the object is a
    procedural one of thirteen categories, with --task heat one of four kinds that is heated at one place, and with
    --task coverage a laid tea mug, to be seen all round.
    """
    actions.demo(SimpleNamespace(**locals()))


def run(
    mesh: MeshArgument,
    task: options.TaskOption = options.COVERAGE,
    network: options.NetworkOption = None,
    category: options.CategoryOption = None,
    source: options.SourceOption = None,
    first: options.FirstOption = None,
    paper: options.PaperOption = False,
    fov: options.FovOption = None,
    radius: options.RadiusOption = None,
    rays: options.RaysOption = None,
    samples: options.SamplesOption = None,
    candidates: options.CandidatesOption = None,
    lengthscale: options.LengthscaleOption = None,
    search: options.SearchOption = options.DISCRETE,
    model: options.ModelOption = options.SCREENED,
    known: options.KnownOption = None,
    views: options.ViewsOption = 5,
    until: options.UntilOption = None,
    seed: options.SeedOption = 0,
    out: options.OutOption = None,
    overwrite: options.OverwriteOption = False,
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
