"""How a command plays an episode: its planner, its race with another search, what it prints and draws."""

import dataclasses
import functools
import operator
import os
import re
import textwrap
import time
from collections.abc import Callable, Sequence
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
from jaxnbv.cli.options import Asked, Position
from jaxnbv.cli.registry import STOPS
from jaxnbv.cli.tasks import Shown
from jaxnbv.geometry.pose import Pose, look_at
from jaxnbv.planning.episode import Episode, Step, simulate
from jaxnbv.planning.planner import Planner
from jaxnbv.planning.stopping import Budget, ValueBelow
from jaxnbv.sampler import SurfaceSampler
from jaxnbv.scanning import Grid, SDFSurface, SensorNoise, Surface, TriangleMesh
from jaxnbv.scanning.sensors import Setting
from jaxnbv.search import Search, SphereCandidates, TieBreakSearch
from jaxnbv.studies.engine import searches
from jaxnbv.surfaces import ShapeBank, Upright
from jaxnbv.surfaces.shipped_banks import SHIPPED_BANKS, bank_poses, shape_bank
from jaxnbv.tasks import Coverage, Covered, Found, StopRule, Sure
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
RULES: dict[str, Callable[[float], StopRule]] = {
    "sure": Sure,
    "found": lambda points: Found(int(points)),
    "covered": Covered,
    "value-below": ValueBelow,
    "seconds": lambda seconds: Budget(seconds=seconds),
    "travel": lambda length: Budget(cost=length),
}
"""What the rules of `--until` stand for."""


def rule(texts: Sequence[str]) -> StopRule | None:
    """The rule that some options make together, "sure=0.95" say; None for none, or "never".

    **Raises:** `ValueError` for a name that is not known, or what is no number.
    """
    if not texts or list(texts) == ["never"]:
        return None
    rules = []
    for text in texts:
        name, _, value = text.partition("=")
        require(name in RULES, f"--until is {text!r}: give never or one of {', '.join(STOPS)}, such as sure=0.95")
        try:
            rules.append(RULES[name](float(value)))
        except (ValueError, OverflowError) as error:
            raise InputError(f"--until is {text!r} ({error}): give a number, such as {name}=0.95") from error
    return functools.reduce(operator.or_, rules)


def search_of(name: str, radius: float, count: int) -> Search:
    """The search of a name, about cameras so far away."""
    candidates = SphereCandidates(count, radius)
    if name == "tie-break":
        return TieBreakSearch(candidates, second=Coverage())
    return searches.search_of(name, candidates, count, radius, num_starts=6, iterations=20)


def imagined(model: str, quick: bool, known: str | None) -> SurfaceSampler:
    """The surfaces of a model's name, by one who knows the shapes of a bank that ships, or upright ones of a folder of
    meshes; none of None or "none".

    **Raises:** `ValueError` if there is no such bank or folder, or no mesh in it that can be used.
    """
    sampler = SurfaceSampler.preset(model, quick=quick)
    if known in (None, "none"):
        return sampler
    if known in SHIPPED_BANKS:
        return sampler.with_bank(shape_bank(known), bank_poses(known))
    require(
        os.path.isdir(known),
        f"--known {known}: there is no such folder of meshes; or give {', '.join(SHIPPED_BANKS)}, none",
    )
    return sampler.with_bank(ShapeBank.from_meshes(known), Upright(by_axis=True))


def planner_of(
    setting: Setting, acquisition: Acquisition, search: str, sampler: SurfaceSampler, sizes: Sizes
) -> Planner:
    """A planner of a task."""
    grid = sizes.grid or sampler.grid
    sampler = dataclasses.replace(sampler, grid=grid, num_samples=sizes.samples)
    found = search_of(search, setting.radius, sizes.candidates or setting.num_candidates)
    camera = setting.camera if sizes.rays is None else setting.camera.resized(sizes.rays, sizes.rays)
    return Planner(acquisition, found, camera, sampler, capacity=sizes.capacity)


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


def play(asked: Asked, shown: Shown, setting: Setting, sizes: Sizes) -> None:
    """Simulate an episode into a folder, tell of each view as it is done, and report; where the object says what is
    enough, farthest view races it from the same first view."""
    began = time.perf_counter()
    if asked.quick:
        typer.echo("--quick: small settings; leave it out for the usual ones.")
        sizes = QUICK
    if shown.note:
        typer.echo(shown.note)
    # The paper's model knows no shapes.
    usual = "none" if asked.model == "paper" else shown.bank
    sampler = dataclasses.replace(imagined(asked.model, asked.quick, asked.known or usual), grid=shown.grid)
    planner = planner_of(setting, shown.acquisition, asked.search, sampler, sizes)
    parts = shown.name, asked.task, asked.search, *(() if asked.model == "screened" else (asked.model,))
    folder = asked.out or Path("runs") / re.sub(r"[^A-Za-z0-9_.-]", "_", f"{'-'.join(parts)}-seed{asked.seed}")
    enough = rule(asked.until or shown.until)
    key, noise = jax.random.key(asked.seed), SensorNoise(asked.noise, asked.noise)
    races = bool(shown.until) and enough is not None and asked.search != "farthest"
    lines = Lines(planner)
    sketches = viz.Sketches(Episode(planner, shown.surface, noise, shown.first, key, ())) if asked.report else None
    race: Future[Episode] | None = None
    drawn: list[Future[None]] = []

    def tell(step: Step) -> None:
        nonlocal race
        lines(step.view)
        if sketches is not None:
            drawn.append(beside.submit(sketches.add, step))
        # Not before the first view: both would compile what that needs.
        if race is None and races:
            rival = planner_of(setting, shown.acquisition, "farthest", sampler, sizes)
            of_rival = (shown.surface, shown.first, _RACE_VIEWS, key, noise, folder / "farthest")
            race = beside.submit(simulate, rival, *of_rival, progress=False, until=enough)

    # While the next view is planned, the last one is drawn and the rival runs.
    with ThreadPoolExecutor(1) as beside:
        try:
            of_planner = (shown.surface, shown.first, asked.views, key, noise, folder)
            episode = simulate(planner, *of_planner, until=enough, each=tell)
        except BaseException:
            beside.shutdown(wait=False, cancel_futures=True)
            raise
    raced = None if race is None else race.result()
    for one in drawn:
        one.result()
    if episode.stopped is not None:
        views, saved = len(episode.views), asked.views - len(episode.views)
        typer.echo(f"enough   after view {views}: {episode.stopped}. Views saved: {saved} of {asked.views}")
    if raced is not None:
        told_of = race_words(raced, episode)
        typer.echo(textwrap.fill(told_of, 100, initial_indent="race     ", subsequent_indent="         "))
    if asked.report:
        page = viz.write_report(episode, folder, title=shown.name, rival=raced, sketches=sketches)
        typer.echo(f"report   {page}")
    typer.echo(f"episode  {folder}   ({time.perf_counter() - began:.0f} s)")
