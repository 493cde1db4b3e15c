"""`jaxnbv demo` and `jaxnbv run MESH`: one episode. `jaxnbv view RUN`: a look at one."""

import dataclasses
import time
from pathlib import Path
from typing import Annotated

import typer

from jaxnbv.cli import options
from jaxnbv.cli.registry import TASKS
from jaxnbv.errors import InputError


def demo(
    task: options.TaskOption = "cross-entropy",
    views: options.ViewsOption = 5,
    until: options.UntilOption = None,
    scene: Annotated[
        int, options.asking(metavar="N", min=0, max=2**31 - 1, help="Which object: the number of a scene.")
    ] = 0,
    first: options.FirstOption = None,
    noise: options.NoiseOption = 0.01,
    model: options.ModelOption = "screened",
    known: options.KnownOption = None,
    search: options.SearchOption = "halving",
    seed: options.SeedOption = 2,
    out: options.OutOption = None,
    quick: options.QuickOption = False,
    report: options.ReportOption = True,
) -> None:
    """Find out what a truck carries, which the first view does not show: no file, no network.

    Farthest view, which knows nothing of the task, then starts from the same view. With --task parts the object is a
    procedural one of thirteen categories, with --task heat one of four kinds that is heated at one place, and with
    --task coverage a mug, to be seen all round.
    """
    from jaxnbv.checks import check_device

    check_device()
    from jaxnbv.cli.play import DEMO, first_pose, play
    from jaxnbv.cli.tasks import COMMAND_TASKS

    made = COMMAND_TASKS[task]
    shown = made.demo(scene, seed)
    if first is not None:
        shown = shown._replace(first=first_pose(first, shown.surface))
    asked = options.Asked(task, views, until, first, noise, model, known, search, seed, out, quick, report)
    play(asked, shown, made.setting, DEMO)


def run(
    mesh: Annotated[
        Path, typer.Argument(metavar="MESH", help="Any mesh that trimesh reads: OBJ, PLY, STL, OFF, glTF, ...")
    ],
    task: options.TaskOption = "coverage",
    views: options.ViewsOption = 5,
    until: options.UntilOption = None,
    network: Annotated[
        Path | None,
        options.asking(
            metavar="FILE",
            help="A classifier, .pth or .safetensors, which tasks about the class need; for parts a segmenter.",
        ),
    ] = None,
    category: Annotated[
        str | None,
        options.asking(
            metavar="NAME",
            help="For parts: what the object is, one of ShapeNet-part's categories; upright along y, facing x.",
        ),
    ] = None,
    source: Annotated[
        options.Position | None,
        options.asking(
            metavar="X Y Z",
            help="For heat: the object is heated at its point nearest to this, in scene units.",
            show_default="the middle of the first view",
        ),
    ] = None,
    up: Annotated[
        str, options.seeing(metavar="AXIS", help="The mesh's axis that is upward: x, y or z, or one of these with a -.")
    ] = "y",
    first: options.FirstOption = None,
    paper: Annotated[
        bool, options.seeing("--paper", help="The paper's close-up: 30 degrees from 2.5 (parts: 2, heat: 3).")
    ] = False,
    noise: options.NoiseOption = 0.01,
    model: options.ModelOption = "screened",
    known: options.KnownOption = None,
    search: options.SearchOption = "discrete",
    seed: options.SeedOption = 0,
    out: options.OutOption = None,
    quick: options.QuickOption = False,
    report: options.ReportOption = True,
) -> None:
    """Choose views of a mesh, scanned by a simulated depth camera.

    The mesh may be open, a soup of triangles or inconsistently wound. It is scaled and centred so that its longest side
    is 2.5 scene units; cameras stand as far from its centre as it takes to see all of it.
    """
    of_task, given = TASKS[task], {"network": network, "category": category, "source": source}
    for option, value in given.items():
        if value is not None and option not in of_task.requires + of_task.options:
            takers = ", ".join(name for name, entry in TASKS.items() if option in entry.requires + entry.options)
            raise InputError(f"--task {task} takes no --{option}: it is for {takers}")
        if value is None and option in of_task.requires:
            raise InputError(f"--task {task} needs --{option}")

    from jaxnbv.checks import check_device

    check_device()
    from jaxnbv.cli.play import USUAL, first_pose, play
    from jaxnbv.cli.tasks import COMMAND_TASKS, Given, Shown, usual_first
    from jaxnbv.scanning import load_mesh
    from jaxnbv.scanning.sensors import fitted

    surface, made = load_mesh(mesh, up), COMMAND_TASKS[task]
    setting = made.setting if paper else fitted(made.setting, surface.bounding_radius)
    usual = usual_first(None if paper else setting.radius)
    start = usual if first is None else first_pose(first, surface)
    acquisition = made.acquisition(Given(surface, setting.camera, start, network, category, source))
    asked = options.Asked(task, views, until, first, noise, model, known, search, seed, out, quick, report)
    play(asked, Shown(mesh.stem, surface, acquisition, start), setting, USUAL)


def view(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="The folder of a run.")],
    html: Annotated[
        Path | None, typer.Option(help="Write the scene into one HTML file, which opens offline, and end.")
    ] = None,
    known: options.KnownOption = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Where the page is served.")] = 8080,
) -> None:
    """Look at a run in the browser: points, cameras, the surface, what is imagined, where to look next.

    Surfaces are those of the usual model given what was seen, by one who knows shapes with --known.
    """
    from jaxnbv.checks import check_device

    check_device()
    from jaxnbv.cli.play import imagined
    from jaxnbv.planning.episode import Episode
    from jaxnbv.viz import LiveView

    episode, page = Episode.load(folder), LiveView(port)
    if known is not None:
        planner = dataclasses.replace(episode.planner, sampler=imagined("screened", False, known))
        episode = dataclasses.replace(episode, planner=planner)
    try:
        page.update(episode)
        if html is not None:
            typer.echo(f"page     {page.save(html)}")
            return
        typer.echo(f"look at {page.address}; end with Ctrl-C")
        while True:
            time.sleep(3600.0)
    except KeyboardInterrupt:
        typer.echo("ended")
    finally:
        page.stop()
