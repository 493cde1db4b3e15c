"""How a command plays an episode: its planner, its race with another search, what it prints and draws."""

import dataclasses
import functools
import operator
import os
import re
import textwrap
import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import typer

from jaxnbv import viz
from jaxnbv.acquisition import Acquisition
from jaxnbv.checks import InputError, require
from jaxnbv.cli.lines import Lines
from jaxnbv.cli.options import Position
from jaxnbv.cli.registry import STOPS
from jaxnbv.cli.searches import search_of
from jaxnbv.geometry.pose import Pose, look_at
from jaxnbv.imagination import Imagination
from jaxnbv.planning.episode import Episode, Step, simulate
from jaxnbv.planning.planner import Planner
from jaxnbv.planning.stopping import Budget, ValueBelow
from jaxnbv.scanning import Grid, SDFSurface, SensorNoise, Surface, TriangleMesh
from jaxnbv.scanning.sensors import Setting
from jaxnbv.studies.scenes.banks import KINDS, bank_poses, shape_bank
from jaxnbv.surfaces import ShapeBank, Upright
from jaxnbv.tasks import Covered, Found, Stop, Sure
from jaxnbv.viz.task import race_words


class Sizes(NamedTuple):
    """Posterior samples, candidates (None: as many as the sensor's setting has), points of D that are kept, the grid of
    the samples (None: the task's own), and rays along a side of an image (None: the sensor's own)."""

    samples: int
    candidates: int | None
    capacity: int
    grid: Grid | None = None
    rays: int | None = None


USUAL, QUICK = Sizes(16, None, 8192), Sizes(4, 40, 1024, Grid(56), 24)
DEMO = Sizes(16, 60, 2048)
# Views of the baseline that races the demo, at most.
_RACE_VIEWS = 10


def usual_folder(name: str, task: str, search: str, model: str, seed: int) -> Path:
    """runs/NAME-TASK-SEARCH[-MODEL]-seedN."""
    parts = name, task, search, *(() if model == "screened" else (model,)), f"seed{seed}"
    return Path("runs") / re.sub(r"[^A-Za-z0-9_.-]", "_", "-".join(parts))


def imagined(model: str, quick: bool, known: str | None) -> Imagination:
    """The surfaces of a model's name, by one who knows the shapes of a bank that ships, or upright ones of a folder of
    meshes; none of None or "none".

    **Raises:** `ValueError` if there is no such bank or folder, or no mesh in it that can be used.
    """
    imagination = Imagination.preset(model, quick=quick)
    if known in (None, "none"):
        return imagination
    if known in KINDS:
        return imagination.knowing(shape_bank(known), bank_poses(known))
    require(
        os.path.isdir(known), f"--known {known}: there is no such folder of meshes; or give {', '.join(KINDS)}, none"
    )
    return imagination.knowing(ShapeBank.from_meshes(known), Upright(by_axis=True))


def planner_of(
    setting: Setting, acquisition: Acquisition, search: str, imagination: Imagination, sizes: Sizes
) -> Planner:
    """A planner of a task."""
    grid = sizes.grid or imagination.grid
    imagination = dataclasses.replace(imagination, grid=grid, num_samples=sizes.samples)
    # A gradient search looks at its own number of candidates before it climbs.
    usual = None if search.startswith("gradient") else setting.num_candidates
    found = search_of(search, setting.radius, sizes.candidates or usual)
    camera = setting.camera if sizes.rays is None else setting.camera.resized(sizes.rays, sizes.rays)
    return Planner(acquisition, found, camera, imagination, capacity=sizes.capacity)


def first_pose(place: Position, surface: Surface) -> Pose:
    """Where the first view was asked for, looking at the origin.

    **Raises:** `ValueError` for a position inside the object.
    """
    pose, inside = look_at(place), False
    if isinstance(surface, TriangleMesh):
        inside = bool(surface.contains(np.array([place]))[0])
    elif isinstance(surface, SDFSurface):
        inside = bool(surface.sdf(jnp.array([place]))[0] < 0)
    require(not inside, f"--first is {place}, inside the object: give a place outside")
    return pose


def rule(texts: Sequence[str]) -> Stop | None:
    """The rule that some options make together, "sure=0.95" say; None for none, or "never".

    **Raises:** `ValueError` for a name that is not known, or what is no number.
    """
    if not texts or list(texts) == ["never"]:
        return None
    return functools.reduce(operator.or_, map(_rule, texts))


def _rule(text: str) -> Stop:
    name, _, value = text.partition("=")
    require(name in STOPS, f"--until is {text!r}: give never or one of {', '.join(STOPS)}, such as sure=0.95")
    try:
        number = float(value)
    except ValueError as error:
        raise InputError(f"--until is {text!r}: give a number, such as {name}=0.95") from error
    if name == "seconds":
        return Budget(seconds=number)
    if name == "travel":
        return Budget(cost=number)
    if name == "found":
        return Found(int(number) if number.is_integer() else number)  # type: ignore[arg-type]
    return {"sure": Sure, "covered": Covered, "value-below": ValueBelow}[name](number)


def play(
    name: str,
    scene: Surface,
    planner: Planner,
    first: Pose,
    views: int,
    seed: int,
    noise: float,
    folder: Path,
    until: Sequence[str] = (),
    quick: bool = False,
    report: bool = True,
    rival: Planner | None = None,
) -> None:
    """Simulate an episode into a folder, tell of each view as it is done, and report; where a rule says what is enough,
    a rival races it from the same first view."""
    enough, start = rule(until), time.perf_counter()
    if quick:
        typer.echo("--quick: small settings; leave it out for the usual ones.")
    key, spread = jax.random.key(seed), SensorNoise(noise, noise)
    lines = Lines(planner)
    sketches = viz.Sketches(Episode(planner, scene, spread, first, key, ())) if report else None
    race: Future[Episode] | None = None
    jobs: list[Future[None]] = []

    def tell(step: Step) -> None:
        nonlocal race
        lines(step.view)
        if views > 1 and not jobs:
            jobs.append(beside.submit(planner.compile, step.evidence))
        if sketches is not None:
            jobs.append(beside.submit(sketches.add, step))
        # Not before the first view: both would compile what that needs.
        if race is None and rival is not None and enough is not None:
            of_rival = (scene, first, _RACE_VIEWS, key, spread, folder / "farthest")
            race = beside.submit(simulate, rival, *of_rival, progress=False, until=enough)

    # While the next view is planned, its search is compiled, the last one is drawn and the rival runs.
    with ThreadPoolExecutor(1) as beside:
        try:
            episode = simulate(planner, scene, first, views, key, spread, folder, until=enough, each=tell)
        except BaseException:
            beside.shutdown(wait=False, cancel_futures=True)
            raise
    raced = None if race is None else race.result()
    for job in jobs:
        job.result()
    if episode.stopped is not None:
        saved = views - len(episode.views)
        are = "is" if saved == 1 else "are"
        typer.echo(f"enough   after view {len(episode.views)}: {episode.stopped}. {saved} of {views} views {are} saved")
    if raced is not None:
        told = race_words(raced, episode)
        typer.echo(textwrap.fill(told, 100, initial_indent="race     ", subsequent_indent="         "))
    if report:
        typer.echo(f"report   {viz.write_report(episode, folder, title=name, rival=raced, sketches=sketches)}")
    typer.echo(f"episode  {folder}   ({time.perf_counter() - start:.0f} s)")
