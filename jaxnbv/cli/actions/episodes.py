"""What `jaxnbv demo` and `jaxnbv run MESH` do: one episode."""

import re
import time
from pathlib import Path

import jax
import numpy as np
import typer

from jaxnbv.acquisition import Score
from jaxnbv.answers import Answer
from jaxnbv.camera import Camera
from jaxnbv.checks import require
from jaxnbv.cli.actions.stops import rule
from jaxnbv.cli.actions.tasks import CommandTask, Given, OfMesh, position
from jaxnbv.cli.options import EpisodeOptions
from jaxnbv.cli.registry import SEARCHES, TASKS, resolve
from jaxnbv.datasets import Framing
from jaxnbv.episode import Episode, simulate
from jaxnbv.model_name import ModelName
from jaxnbv.planner import Planner
from jaxnbv.pose import Pose, look_at
from jaxnbv.presets import imagination
from jaxnbv.scanning import Grid, SensorNoise, Surface, load_mesh
from jaxnbv.sensors import Setting
from jaxnbv.viz import write_report


def demo(task: str, scene: int, framing: Framing, first: str | None, options: EpisodeOptions) -> None:
    """One episode of a shipped object."""
    made: CommandTask = resolve(TASKS[task].task)
    shown = made.demo(scene, framing, options.seed)
    if shown.told:
        typer.echo(shown.told)
    start = shown.first if first is None else look_at(position("--first", first))
    own = shown.longest_side, shown.solid, shown.grid
    planner = planner_of(made.setting, shown.score, options.search, options.model, options.quick, *own)
    _run(shown.name, shown.surface, planner, start, options, shown.until)


def run(
    mesh: Path,
    task: str,
    network: Path | None,
    category: str | None,
    source: str | None,
    first: str,
    options: EpisodeOptions,
) -> None:
    """One episode of a mesh of the user's.

    **Raises:** `ValueError` for a task without what it needs, or with what it has no use for.
    """
    surface, start = load_mesh(mesh), look_at(position("--first", first))
    given = Given(OfMesh(surface, start), network, category, source)
    made = task_for(task, given)
    planner = planner_of(made.setting, made.score(given), options.search, options.model, options.quick)
    _run(mesh.stem, surface, planner, start, options)


def task_for(task: str, given: Given) -> CommandTask:
    """The task of a name.

    **Raises:** `ValueError` if it lacks what it needs, or was given what it has no use for.
    """
    for option in ("network", "category", "source"):
        takers = ", ".join(name for name, entry in TASKS.items() if option in entry.options)
        useless = getattr(given, option) is not None and option not in TASKS[task].options
        require(not useless, f"--task {task} takes no --{option}: it is for {takers}")
    for option, hint in TASKS[task].requires:
        require(getattr(given, option) is not None, f"--task {task} needs {hint}")
    made: CommandTask = resolve(TASKS[task].task)
    return made


def planner_of(
    setting: Setting,
    score: Score,
    search: str,
    model: ModelName,
    quick: bool,
    longest_side: float = 2.5,
    solid: bool = False,
    grid: Grid = Grid(),
) -> Planner:
    """At the authors' settings, or at small ones, for an object of this longest side."""
    surfaces, carving = imagination(model, longest_side, quick, solid=solid)
    found = resolve(SEARCHES[search].search)
    if quick:
        small = Camera(height=24, width=24)
        return Planner(surfaces, small, score, found(setting.radius, 40), 4, Grid(56), 1024, carving=carving)
    # A gradient search looks at its own number of candidates before it climbs.
    count = None if search.startswith("gradient") else setting.num_candidates
    return Planner(surfaces, setting.camera, score, found(setting.radius, count), grid=grid, carving=carving)


def _run(
    name: str, scene: Surface, planner: Planner, first: Pose, options: EpisodeOptions, until: tuple[str, ...] = ()
) -> None:
    enough, start = rule(options.until or until), time.perf_counter()
    of_model = "" if options.model is ModelName.SCREENED else f"-{options.model}"
    usual = Path("runs") / f"{re.sub(r'[^A-Za-z0-9_.-]', '_', name)}-{options.search}{of_model}"
    folder = options.out or usual
    if options.quick:
        typer.echo("--quick: small settings; leave it out for the paper's.")
    key, noise = jax.random.key(options.seed), SensorNoise(options.noise, options.noise)
    episode = simulate(planner, scene, first, options.views, key, noise, folder, until=enough)
    _summarise(episode)
    if episode.stopped is not None:
        saved = options.views - len(episode.views)
        views = "view is" if saved == 1 else "views are"
        typer.echo(
            f"enough   after view {len(episode.views)}: {episode.stopped}. {saved} of {options.views} {views} saved"
        )
    if options.report:
        typer.echo(f"report   {write_report(episode, folder, title=name)}")
    typer.echo(f"episode  {folder}   ({time.perf_counter() - start:.0f} s)")


def _summarise(episode: Episode) -> None:
    """Lines for each view: where from, why, and what it told."""
    score = episode.planner.acquisition
    sought = episode.planner.quantity
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
                level = view.proposal.others_level
                line += "" if level is None else f", {level} of them within two standard errors"
            else:
                best = values.max(initial=-np.inf)
                better = "found nothing better" if float(view.proposal.value) <= best else f"improved on {best:.4g}"
                line += f"where ascent from {len(ways.values)} of {len(values)} candidates {better}"
        typer.echo(line)
        answer = score.answer(view.cloud)
        if answer is not None:
            typer.echo(f"         {answer.line(before)}")
        before = answer
