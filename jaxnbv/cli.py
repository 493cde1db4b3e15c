"""The command line: `jaxnbv demo` and `jaxnbv run MESH`."""

import os
import re
import sys
import time
from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import jax
import numpy as np
import platformdirs
import typer

from jaxnbv.camera import Camera, look_at
from jaxnbv.checks import InputError, require
from jaxnbv.datasets import demo_object
from jaxnbv.episode import Episode, simulate
from jaxnbv.planner import Planner
from jaxnbv.scanning import Grid, SensorNoise, Surface, load_mesh
from jaxnbv.search import DiscreteSearch, FarthestView, RandomView, Search, UncertaintyView
from jaxnbv.surfaces import GeometricSPSR
from jaxnbv.tasks import Coverage
from jaxnbv.viz import write_report


class Task(StrEnum):
    """What the views are for."""

    COVERAGE = "coverage"


class SearchName(StrEnum):
    """How the next view is found."""

    DISCRETE = "discrete"
    FARTHEST = "farthest"
    RANDOM = "random"
    UNCERTAINTY = "uncertainty"


class Device(StrEnum):
    """Where the computation runs."""

    AUTO = "auto"
    CPU = "cpu"
    GPU = "gpu"


TASKS = {Task.COVERAGE: Coverage}
SEARCHES: dict[SearchName, Callable[..., Search]] = {
    SearchName.DISCRETE: DiscreteSearch,
    SearchName.FARTHEST: FarthestView,
    SearchName.RANDOM: RandomView,
    SearchName.UNCERTAINTY: UncertaintyView,
}

app = typer.Typer(
    help="""Where should the sensor look next, for what you want to know?

    jaxnbv scans an object from a first view, imagines what it may look like where it was not seen, and picks the view
    that is expected to tell the most; then it scans from there and asks again. Each run leaves a folder with the
    episode (poses, scans, the values of all candidates), its point cloud as PLY, figures, and a report.html that opens
    offline.

    Try `jaxnbv demo`, then `jaxnbv run MESH --views 5 --out runs/mine`.
    """,
    epilog="A run that was interrupted continues with the same command after its last finished view.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    add_completion=False,
    pretty_exceptions_enable=False,
)

TaskOption = Annotated[Task, typer.Option(help="What the views are for.")]
SearchOption = Annotated[
    SearchName,
    typer.Option(
        help="How the next view is found: discrete is the expected value of the task over 120 candidates; "
        "farthest, random and uncertainty are the paper's baselines over the same candidates."
    ),
]
ViewsOption = Annotated[int, typer.Option(help="Views in all, the first one included.")]
FirstOption = Annotated[
    str, typer.Option(help="Position of the first camera, x,y,z in scene units; it looks at the origin.")
]
SeedOption = Annotated[
    int, typer.Option(min=0, max=2**63 - 1, help="Seed of the sensor's noise and of the posterior samples.")
]
OutOption = Annotated[Path | None, typer.Option(help="Output folder.", show_default="runs/NAME-SEARCH")]
NoiseOption = Annotated[float, typer.Option(help="Standard deviation of the sensor's noise on points and normals.")]
QuickOption = Annotated[
    bool, typer.Option("--quick", help="Small settings, for a first look in under a minute; not the paper's.")
]
ReportOption = Annotated[bool, typer.Option("--report/--no-report", help="Write report.html and the figures.")]
DeviceOption = Annotated[Device, typer.Option(help="Where to compute; auto takes a GPU if JAX sees one.")]


@app.command()
def demo(
    task: TaskOption = Task.COVERAGE,
    search: SearchOption = SearchName.DISCRETE,
    views: ViewsOption = 5,
    first: FirstOption = "0.8,0.9,2.2",
    seed: SeedOption = 0,
    out: OutOption = None,
    noise: NoiseOption = 0.01,
    quick: QuickOption = False,
    report: ReportOption = True,
    device: DeviceOption = Device.AUTO,
) -> None:
    """Choose views of an object that ships with jaxnbv: no file, no network."""
    _prepare(device)
    _run("demo", demo_object(), task, search, views, first, seed, out, noise, quick, report)


@app.command()
def run(
    mesh: Annotated[
        Path, typer.Argument(metavar="MESH", help="Any mesh that trimesh reads: OBJ, PLY, STL, OFF, glTF, ...")
    ],
    task: TaskOption = Task.COVERAGE,
    search: SearchOption = SearchName.DISCRETE,
    views: ViewsOption = 5,
    first: FirstOption = "0.8,0.9,2.2",
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
    _prepare(device)
    _run(mesh.stem, load_mesh(mesh), task, search, views, first, seed, out, noise, quick, report)


def _prepare(device: Device) -> None:
    """Choose the device and keep compiled programs for later runs."""
    if device is not Device.AUTO:
        try:
            jax.config.update("jax_default_device", jax.devices(device.value)[0])
        except RuntimeError as error:
            raise InputError(
                f"no {device.value} that JAX can use ({error}): leave --device out, or install the extra named cuda"
            ) from error
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        jax.config.update("jax_compilation_cache_dir", str(platformdirs.user_cache_path("jaxnbv") / "xla"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


def _run(
    name: str,
    scene: Surface,
    task: Task,
    search: SearchName,
    views: int,
    first: str,
    seed: int,
    out: Path | None,
    noise: float,
    quick: bool,
    report: bool,
) -> None:
    start = time.perf_counter()
    folder = out or Path("runs") / f"{re.sub(r'[^A-Za-z0-9_.-]', '_', name)}-{search.value}"
    planner = _planner(task, search, quick)
    if quick:
        typer.echo("--quick: small settings; leave it out for the paper's.")
    episode = simulate(
        planner,
        scene,
        first=look_at(_position(first)),
        views=views,
        key=jax.random.key(seed),
        noise=SensorNoise(noise, noise),
        folder=folder,
    )
    _summarise(episode)
    if report:
        typer.echo(f"report   {write_report(episode, folder, title=name)}")
    typer.echo(f"episode  {folder}   ({time.perf_counter() - start:.0f} s)")


def _planner(task: Task, search: SearchName, quick: bool) -> Planner:
    score = TASKS[task]()
    if not quick:
        return Planner(GeometricSPSR(), Camera(), score, SEARCHES[search]())
    model = GeometricSPSR(lengthscale=0.012, truncation=24)
    camera = Camera(height=24, width=24)
    return Planner(model, camera, score, SEARCHES[search](num_candidates=40), 4, Grid(56), capacity=2048)


def _position(text: str) -> tuple[float, float, float]:
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError as error:
        raise InputError(f"--first is {text!r}; give three numbers such as 0.8,0.9,2.2") from error
    require(bool(np.isfinite([x, y, z]).all()), f"--first is {text!r}; its numbers must be finite")
    return x, y, z


def _summarise(episode: Episode) -> None:
    """A line a view: where from, what for, and how much it added."""
    for index, view in enumerate(episode.views, start=1):
        seen, kept = int(view.scan.count), int(view.cloud.count)
        position = ", ".join(f"{value:+.2f}" for value in np.asarray(view.pose.position))
        line = f"view {index}   from ({position})   {seen:5d} points, {kept:5d} kept"
        if view.proposal is not None:
            values = np.asarray(view.proposal.values)
            line += f"   value {float(view.proposal.value):.4g} (median {np.median(values[np.isfinite(values)]):.4g})"
        typer.echo(line)


def main() -> None:
    """Entry point: errors that the user can mend are one line, without a traceback."""
    try:
        app()
    except InputError as error:
        typer.echo(f"error: {error}", err=True)
        sys.exit(2)


if __name__ == "__main__":
    main()
