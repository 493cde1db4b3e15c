"""What `jaxnbv demo` and `jaxnbv run MESH` do: one episode."""

import dataclasses
import os
import re
import textwrap
import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import typer

from jaxnbv import viz
from jaxnbv.acquisition import Acquisition
from jaxnbv.checks import require
from jaxnbv.cli.actions.device import prepare
from jaxnbv.cli.actions.lines import Lines
from jaxnbv.cli.actions.searches import search_of
from jaxnbv.cli.actions.sensors import first_pose, peculiarities, sensor_for, with_rays
from jaxnbv.cli.actions.tasks import COMMAND_TASKS, CommandTask, Given, usual_first
from jaxnbv.cli.actions.until import rule
from jaxnbv.cli.registry import TASKS
from jaxnbv.geometry.pose import Pose
from jaxnbv.imagination import Imagination
from jaxnbv.planning.episode import Episode, Step, simulate
from jaxnbv.planning.planner import Planner
from jaxnbv.scanning import Grid, SensorNoise, Surface, load_mesh, scan
from jaxnbv.scanning.sensors import Setting
from jaxnbv.studies.scenes.banks import KINDS, bank_poses, shape_bank
from jaxnbv.surfaces import ShapeBank, Upright
from jaxnbv.viz.task import race_words


class Sizes(NamedTuple):
    """Posterior samples, candidates (None: as many as the sensor's setting has), points of D that are kept, and the
    grid of the samples (None: the task's own)."""

    samples: int
    candidates: int | None
    capacity: int
    grid: Grid | None = None


USUAL, QUICK = Sizes(16, None, 8192), Sizes(4, 40, 1024, Grid(56))
DEMO = Sizes(16, 60, 2048)
# The baseline that races the demo: its folder within the demo's, and its views at most.
_RIVAL, _RACE_VIEWS = "farthest", 10


def demo(asked: SimpleNamespace) -> None:
    """One episode of a shipped object; where a rule says what is enough, `FarthestView` races it.

    **Raises:** `ValueError` for a first view from inside the object.
    """
    prepare(asked.device)
    made = COMMAND_TASKS[asked.task]
    shown = made.demo(asked.scene, asked.seed)
    if shown.note:
        typer.echo(shown.note)
    start = shown.first if asked.first is None else first_pose(asked.first, shown.surface)
    setting = with_rays(made.setting, asked.quick)
    # The paper's model knows no shapes.
    usual = None if asked.model == "paper" else shown.bank
    known = usual if asked.known is None else asked.known
    imagination = dataclasses.replace(
        knowing(Imagination.preset(asked.model, quick=asked.quick), known), grid=shown.grid
    )
    sizes = QUICK if asked.quick else DEMO
    planner = planner_of(setting, shown.acquisition, asked.search, imagination, sizes)
    races = bool(shown.until) and asked.search != "farthest"
    rival = planner_of(setting, shown.acquisition, "farthest", imagination, sizes) if races else None
    _run(shown.name, shown.surface, planner, start, asked, rival, shown.until)


def run(asked: SimpleNamespace) -> None:
    """One episode of a mesh of the user's.

    **Raises:** `ValueError` for a task without what it needs, or with what it has no use for, a sensor that cannot see
    the object, and a first view from inside it.
    """
    prepare(asked.device)
    options = {"network": asked.network, "category": asked.category, "source": asked.source}
    surface, made = load_mesh(asked.mesh), task_for(asked.task, **options)
    setting = sensor_for(surface, made.setting, asked)
    usual = usual_first(None if asked.paper else setting.radius)
    start = usual if asked.first is None else first_pose(asked.first, surface)
    given = Given(
        start,
        lambda: surface.sample_points(jax.random.key(0), 20_000),
        lambda: scan(surface, setting.camera, start).to_numpy()[0],
        **options,
    )
    plain = Imagination.preset(asked.model, quick=asked.quick, lengthscale=asked.lengthscale)
    sizes = QUICK if asked.quick else USUAL
    sizes = sizes._replace(samples=asked.samples or sizes.samples, candidates=asked.candidates or sizes.candidates)
    planner = planner_of(setting, made.acquisition(given), asked.search, knowing(plain, asked.known), sizes)
    for words in peculiarities(asked.mesh, surface, planner.imagination.grid.spacing):
        typer.echo(f"note     {words}")
    _run(asked.mesh.stem, surface, planner, start, asked)


def knowing(imagination: Imagination, known: str | None) -> Imagination:
    """One that knows the shapes of a bank that ships, or upright ones of a folder of meshes; none of None or "none".

    **Raises:** `ValueError` if there is no such bank or folder, or no mesh in it that can be used.
    """
    if known in (None, "none"):
        return imagination
    if known in KINDS:
        return imagination.knowing(shape_bank(known), bank_poses(known))
    require(
        os.path.isdir(known), f"--known {known}: there is no such folder of meshes; or give {', '.join(KINDS)}, none"
    )
    return imagination.knowing(ShapeBank.from_meshes(known), Upright(by_axis=True))


def task_for(task: str, **given: Any) -> CommandTask:
    """The task of a name, given its `network`, `category` and `source`; None where not.

    **Raises:** `ValueError` if it lacks what it needs, or was given what it has no use for.
    """
    for option, value in given.items():
        takers = ", ".join(name for name, entry in TASKS.items() if option in entry.options)
        useless = value is not None and option not in TASKS[task].options
        require(not useless, f"--task {task} takes no --{option}: it is for {takers}")
    for option, hint in TASKS[task].requires:
        require(given[option] is not None, f"--task {task} needs {hint}")
    return COMMAND_TASKS[task]


def planner_of(
    setting: Setting, acquisition: Acquisition, search: str, imagination: Imagination, sizes: Sizes
) -> Planner:
    """A planner of a task."""
    grid = sizes.grid or imagination.grid
    imagination = dataclasses.replace(imagination, grid=grid, num_samples=sizes.samples)
    # A gradient search looks at its own number of candidates before it climbs.
    usual = None if search.startswith("gradient") else setting.num_candidates
    found = search_of(search, setting.radius, sizes.candidates or usual)
    return Planner(acquisition, found, setting.camera, imagination, capacity=sizes.capacity)


def _run(
    name: str,
    scene: Surface,
    planner: Planner,
    first: Pose,
    asked: SimpleNamespace,
    rival: Planner | None = None,
    until: tuple[str, ...] = (),
) -> None:
    enough, start = rule(asked.until or until), time.perf_counter()
    parts = name, asked.task, asked.search, *(() if asked.model == "screened" else (asked.model,)), f"seed{asked.seed}"
    folder = asked.out or Path("runs") / re.sub(r"[^A-Za-z0-9_.-]", "_", "-".join(parts))
    if asked.quick:
        typer.echo("--quick: small settings; leave it out for the usual ones.")
    key, noise = jax.random.key(asked.seed), SensorNoise(asked.noise, asked.noise)
    lines = Lines(planner)
    sketches = viz.Sketches(Episode(planner, scene, noise, first, key, ())) if asked.report else None
    race: Future[Episode] | None = None
    drawn: list[Future[None]] = []

    def tell(step: Step) -> None:
        nonlocal race
        lines(step.view)
        if sketches is not None:
            drawn.append(beside.submit(sketches.add, step))
        # Not before the first view: both would compile what that needs.
        if race is None and rival is not None and enough is not None:
            of_rival = (scene, first, _RACE_VIEWS, key, noise, folder / _RIVAL)
            race = beside.submit(simulate, rival, *of_rival, progress=False, until=enough)

    # While the next view is planned, the last one is drawn and the rival runs.
    with ThreadPoolExecutor(1) as beside:
        try:
            episode = simulate(planner, scene, first, asked.views, key, noise, folder, until=enough, each=tell)
        except BaseException:
            beside.shutdown(wait=False, cancel_futures=True)
            raise
    raced = None if race is None else race.result()
    for one in drawn:
        one.result()
    if episode.stopped is not None:
        saved = asked.views - len(episode.views)
        are = "is" if saved == 1 else "are"
        typer.echo(
            f"enough   after view {len(episode.views)}: {episode.stopped}. {saved} of {asked.views} views {are} saved"
        )
    if raced is not None:
        told = race_words(raced, episode)
        typer.echo(textwrap.fill(told, 100, initial_indent="race     ", subsequent_indent="         "))
    if asked.report:
        typer.echo(f"report   {viz.write_report(episode, folder, title=name, rival=raced, sketches=sketches)}")
    typer.echo(f"episode  {folder}   ({time.perf_counter() - start:.0f} s)")
