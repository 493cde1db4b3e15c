"""`jaxnbv demo` and `jaxnbv run MESH`: one episode."""

import re
import time
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import typer

from jaxnbv.acquisition import ExpectedUtilityImprovement, Score
from jaxnbv.camera import Camera, Pose, look_at
from jaxnbv.checks import InputError, require
from jaxnbv.cli.options import (
    Device,
    DeviceOption,
    FramingOption,
    NoiseOption,
    OutOption,
    QuickOption,
    ReportOption,
    SearchName,
    SearchOption,
    SeedOption,
    Task,
    TaskOption,
    ViewsOption,
    prepare,
)
from jaxnbv.datasets import PATTERNS, Framing, Split, demo_object, hidden_view, pyramid_scene
from jaxnbv.episode import Episode, simulate
from jaxnbv.networks import CloudClassifier, load_checkpoint, pyramid_classifier
from jaxnbv.planner import Planner
from jaxnbv.scanning import Grid, SDFSurface, SensorNoise, Surface, load_mesh
from jaxnbv.search import (
    ConstrainedPoses,
    DiscreteSearch,
    FarthestView,
    GradientSearch,
    HybridSearch,
    RandomView,
    UncertaintyView,
)
from jaxnbv.surfaces import GeometricSPSR
from jaxnbv.tasks import Classifier, Coverage, CrossEntropy, MixedEntropy, NegativeEntropy
from jaxnbv.tasks.classification import class_names, predict
from jaxnbv.viz import write_report
from jaxnbv.viz.words import quantity

SEARCHES: dict[SearchName, Any] = {
    SearchName.DISCRETE: DiscreteSearch,
    SearchName.GRADIENT_2DOF: partial(GradientSearch, dof=2),
    SearchName.GRADIENT_6DOF: partial(GradientSearch, space=ConstrainedPoses()),
    SearchName.HYBRID: HybridSearch,
    SearchName.FARTHEST: FarthestView,
    SearchName.RANDOM: RandomView,
    SearchName.UNCERTAINTY: UncertaintyView,
}

FirstOption = Annotated[
    str, typer.Option(help="Position of the first camera, x,y,z in scene units; it looks at the origin.")
]
DEFAULT_FIRST = "0.8,0.9,2.2"


def demo(
    task: TaskOption = Task.CROSS_ENTROPY,
    search: SearchOption = SearchName.DISCRETE,
    views: ViewsOption = 5,
    scene: Annotated[int, typer.Option(min=0, help="Which pyramid of the test split.")] = 0,
    framing: FramingOption = Framing.WHOLE,
    first: Annotated[
        str | None,
        typer.Option(help="Position of the first camera, x,y,z.", show_default="one that does not show the pattern"),
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
    with --framing close-up a view shows a patch of it. With --task coverage the object is a laid tea mug, to be seen
    all round; --scene and --framing do not matter then.
    """
    prepare(device)
    if task is Task.COVERAGE:
        planner, start = _planner(Coverage(), search, quick), look_at(_position(first or DEFAULT_FIRST))
        _run("mug", search, demo_object(), planner, start, views, seed, out, noise, quick, report)
        return
    pyramid = pyramid_scene(Split.TEST, scene, framing)
    score = _score(task, pyramid_classifier(framing.longest_side))
    planner = _planner(score, search, quick) if quick else _pyramid_planner(score, search, framing)
    typer.echo(f"the pattern is a {PATTERNS[int(pyramid.label)]}")
    start = hidden_view(pyramid, jax.random.key(seed)) if first is None else look_at(_position(first))
    _run("pyramid", search, SDFSurface(pyramid), planner, start, views, seed, out, noise, quick, report)


def run(
    mesh: Annotated[
        Path, typer.Argument(metavar="MESH", help="Any mesh that trimesh reads: OBJ, PLY, STL, OFF, glTF, ...")
    ],
    task: TaskOption = Task.COVERAGE,
    network: Annotated[
        Path | None,
        typer.Option(help="A PointNet++ classifier, .pth or .safetensors, for the tasks that are about the class."),
    ] = None,
    search: SearchOption = SearchName.DISCRETE,
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
    prepare(device)
    require(
        (network is None) == (task is Task.COVERAGE),
        f"--task {task} with --network {network}: the tasks about the class need a network, coverage takes none",
    )
    # Published networks saw objects scaled into the unit sphere; in the scene half the longest side is 1.25.
    score = Coverage() if network is None else _score(task, CloudClassifier(load_checkpoint(network), scale=1 / 1.25))
    scene = load_mesh(mesh)
    planner = _planner(score, search, quick)
    _run(mesh.stem, search, scene, planner, look_at(_position(first)), views, seed, out, noise, quick, report)


def _score(task: Task, classifier: Classifier) -> Score:
    if task is Task.ENTROPY:
        return ExpectedUtilityImprovement(NegativeEntropy(classifier), num_points=1024)
    return CrossEntropy(classifier) if task is Task.CROSS_ENTROPY else MixedEntropy(classifier)


def _pyramid_planner(score: Score, search: SearchName, framing: Framing) -> Planner:
    """The surfaces are imagined as those were that the classifier was trained on."""
    model, grid = GeometricSPSR(lengthscale=0.01, truncation=32), Grid(64, 0.7 * framing.longest_side)
    return Planner(model, Camera(), score, SEARCHES[search](), grid=grid)


def _planner(score: Score, search: SearchName, quick: bool) -> Planner:
    if not quick:
        return Planner(GeometricSPSR(), Camera(), score, SEARCHES[search]())
    model = GeometricSPSR(lengthscale=0.012, truncation=24)
    camera = Camera(height=24, width=24)
    return Planner(model, camera, score, SEARCHES[search](num_candidates=40), 4, Grid(56), capacity=2048)


def _run(
    name: str,
    search: SearchName,
    scene: Surface,
    planner: Planner,
    first: Pose,
    views: int,
    seed: int,
    out: Path | None,
    noise: float,
    quick: bool,
    report: bool,
) -> None:
    start = time.perf_counter()
    folder = out or Path("runs") / f"{re.sub(r'[^A-Za-z0-9_.-]', '_', name)}-{search}"
    if quick:
        typer.echo("--quick: small settings; leave it out for the paper's.")
    episode = simulate(planner, scene, first, views, jax.random.key(seed), SensorNoise(noise, noise), folder)
    _summarise(episode)
    if report:
        typer.echo(f"report   {write_report(episode, folder, title=name)}")
    typer.echo(f"episode  {folder}   ({time.perf_counter() - start:.0f} s)")


def _position(text: str) -> tuple[float, float, float]:
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError as error:
        raise InputError(f"--first is {text!r}; give three numbers such as 0.8,0.9,2.2") from error
    require(bool(np.isfinite([x, y, z]).all()), f"--first is {text!r}; its numbers must be finite")
    return x, y, z


def _summarise(episode: Episode) -> None:
    """Lines for each view: where from, why, and what it told."""
    score = episode.planner.acquisition
    sought = quantity(episode.planner.search, score)
    before = None
    for index, view in enumerate(episode.views, start=1):
        position = ", ".join(f"{value:+.2f}" for value in np.asarray(view.pose.position))
        line = f"view {index}   from ({position})   {int(view.scan.count):5d} points, {int(view.cloud.count):5d} kept"
        if view.proposal is not None:
            values = np.asarray(view.proposal.values)
            values = values[np.isfinite(values)]
            line += f"   {sought.name} {float(view.proposal.value):.4g}, "
            if (ways := view.proposal.trajectories) is None:
                line += f"the highest of {len(values)} candidates"
                line += f" (median {np.median(values):.4g})" if sought.smooth else ""
            else:
                best = values.max(initial=-np.inf)
                better = "found nothing better" if float(view.proposal.value) <= best else f"improved on {best:.4g}"
                line += f"where ascent from {len(ways.values)} of {len(values)} candidates {better}"
        typer.echo(line)
        log_p = predict(score, view.cloud)
        if log_p is not None:
            after = np.exp(np.asarray(log_p))
            names = class_names(score) or tuple(str(number) for number in range(len(after)))
            shown = sorted(np.argsort(-after)[:5])
            changes = (f"{names[c]} {'' if before is None else f'{before[c]:.2f} -> '}{after[c]:.2f}" for c in shown)
            typer.echo(f"         {'   '.join(changes)}")
            before = after
