"""What `jaxnbv demo` and `jaxnbv run MESH` do: one episode."""

import re
import time
from pathlib import Path

import jax
import numpy as np
import typer

from jaxnbv.acquisition import Score
from jaxnbv.answers import Answer
from jaxnbv.camera import Camera, Pose, look_at
from jaxnbv.checks import InputError, require
from jaxnbv.cli.actions.planners import (
    CLASS_TASKS,
    class_score,
    heat_score,
    mesh_score,
    part_score,
    pyramid_planner,
    task_planner,
)
from jaxnbv.cli.options import DEFAULT_FIRST, EpisodeOptions, Task
from jaxnbv.datasets import (
    PATTERNS,
    Framing,
    Split,
    demo_object,
    heat_scene,
    hidden_view,
    part_scene,
    pyramid_scene,
    source_view,
)
from jaxnbv.episode import Episode, simulate
from jaxnbv.model_name import ModelName
from jaxnbv.networks import CATEGORIES, pyramid_classifier
from jaxnbv.planner import Planner
from jaxnbv.scanning import SDFSurface, SensorNoise, Surface, TriangleMesh, load_mesh, scan
from jaxnbv.tasks import Coverage
from jaxnbv.tasks.diffusion import HeatProblem
from jaxnbv.viz import write_report


def demo(task: Task, scene: int, framing: Framing, first: str | None, options: EpisodeOptions) -> None:
    """One episode of a shipped object."""
    name, surface, score, start = _demo_scene(task, scene, framing, options.seed)
    if task in CLASS_TASKS and not options.quick:
        planner = pyramid_planner(score, options.search, options.model, framing)
    else:
        side = framing.longest_side if task in CLASS_TASKS else Framing.CLOSE_UP.longest_side
        planner = task_planner(task, score, options.search, options.model, options.quick, side)
    if first is not None:
        start = look_at(_position("--first", first))
    _run(name, surface, planner, start, options)


def _demo_scene(task: Task, scene: int, framing: Framing, seed: int) -> tuple[str, Surface, Score, Pose]:
    """An object to show a task on: its name, its surface, the score, and a first view."""
    start = look_at(_position("--first", DEFAULT_FIRST))
    if task is Task.COVERAGE:
        return "mug", demo_object(), Coverage(), start
    if task is Task.PARTS:
        thing = part_scene(Split.TEST, scene)
        category = CATEGORIES[int(thing.category)].name
        return f"{category}-parts", SDFSurface(thing.solid), part_score(category), start
    if task is Task.HEAT:
        heated = heat_scene(scene)
        start = source_view(heated, jax.random.key(seed))
        return f"{heated.name}-heat", heated.surface, heat_score(np.asarray(heated.source)), start
    pyramid = pyramid_scene(Split.TEST, scene, framing)
    typer.echo(f"the pattern is a {PATTERNS[int(pyramid.label)]}")
    score = class_score(task, pyramid_classifier(framing.longest_side))
    return "pyramid", SDFSurface(pyramid), score, hidden_view(pyramid, jax.random.key(seed))


def run(
    mesh: Path,
    task: Task,
    network: Path | None,
    category: str | None,
    source: str | None,
    first: str,
    options: EpisodeOptions,
) -> None:
    """One episode of a mesh of the user's."""
    surface, start = load_mesh(mesh), look_at(_position("--first", first))
    require(source is None or task is Task.HEAT, f"--task {task} takes no --source: it is for heat")
    heated = _heat_source(surface, start, source) if task is Task.HEAT else None
    score = mesh_score(task, network, category, heated)
    planner = task_planner(task, score, options.search, options.model, options.quick)
    _run(mesh.stem, surface, planner, start, options)


def _heat_source(surface: TriangleMesh, first: Pose, source: str | None) -> np.ndarray:
    """The point that was asked for, or the one in the middle of the first view."""
    if source is not None:
        place = np.asarray(_position("--source", source))
        points = surface.sample_points(jax.random.key(0), 20_000)
        nearest = points[np.linalg.norm(points - place, axis=1).argmin()]
        distance = float(np.linalg.norm(nearest - place))
        require(
            distance <= HeatProblem.radius,
            f"--source is {source}, {distance:.2f} away from the object, but heat goes in within {HeatProblem.radius} "
            f"only. The nearest point is {','.join(f'{x:.2f}' for x in nearest)}",
        )
        return place
    points, _ = scan(surface, Camera(), first).to_numpy()
    require(len(points) > 0, "the first view does not see the object: give another --first, or a --source")
    along = (points - np.asarray(first.position)) @ np.asarray(first.forward)
    beside = np.linalg.norm(points - np.asarray(first.position) - along[:, None] * np.asarray(first.forward), axis=1)
    return points[beside.argmin()]


def _run(name: str, scene: Surface, planner: Planner, first: Pose, options: EpisodeOptions) -> None:
    start = time.perf_counter()
    of_model = "" if options.model is ModelName.SCREENED else f"-{options.model}"
    usual = Path("runs") / f"{re.sub(r'[^A-Za-z0-9_.-]', '_', name)}-{options.search}{of_model}"
    folder = options.out or usual
    if options.quick:
        typer.echo("--quick: small settings; leave it out for the paper's.")
    key, noise = jax.random.key(options.seed), SensorNoise(options.noise, options.noise)
    episode = simulate(planner, scene, first, options.views, key, noise, folder)
    _summarise(episode)
    if options.report:
        typer.echo(f"report   {write_report(episode, folder, title=name)}")
    typer.echo(f"episode  {folder}   ({time.perf_counter() - start:.0f} s)")


def _position(option: str, text: str) -> tuple[float, float, float]:
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError as error:
        raise InputError(f"{option} is {text!r}; give three numbers such as 0.8,0.9,2.2") from error
    require(bool(np.isfinite([x, y, z]).all()), f"{option} is {text!r}; its numbers must be finite")
    return x, y, z


def _summarise(episode: Episode) -> None:
    """Lines for each view: where from, why, and what it told."""
    score = episode.planner.acquisition
    sought = episode.planner.search.quantity(score)
    before: Answer | None = None
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
        answer = score.answer(view.cloud)
        if answer is not None:
            typer.echo(f"         {answer.line(before)}")
        before = answer
