"""Simulates the episode of a command: makes the planner, runs a baseline to compare, writes results and drawings."""

import dataclasses
import functools
import operator
import os
import re
import textwrap
import time
from collections.abc import Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import typer

from jaxnbv import viz
from jaxnbv.acquisition import Acquisition
from jaxnbv.checks import InputError, require
from jaxnbv.cli.background import in_background
from jaxnbv.cli.episode import EpisodeOptions
from jaxnbv.cli.lines import Lines
from jaxnbv.cli.options import Position
from jaxnbv.cli.registry import STOPS
from jaxnbv.cli.tasks.base import Subject
from jaxnbv.geometry.pose import Pose, look_at
from jaxnbv.planning.episode import Episode
from jaxnbv.planning.loop import Step
from jaxnbv.planning.planner import Planner
from jaxnbv.planning.simulate import simulate
from jaxnbv.planning.stopping import StopRule
from jaxnbv.sampler import SurfaceSampler
from jaxnbv.scanning import Grid, SensorNoise, Surface
from jaxnbv.scanning.sensors import Setting
from jaxnbv.search import Search, SphereCandidates, TieBreakSearch
from jaxnbv.studies.engine import searches
from jaxnbv.surfaces import FreeRotation, ShapeBank, Upright
from jaxnbv.surfaces.shipped_banks import SHIPPED_BANKS, bank_poses, shape_bank
from jaxnbv.tasks import Coverage
from jaxnbv.viz.task import race_words


class Sizes(NamedTuple):
    """Sizes of a planner.

    - `samples`: number of posterior samples.
    - `candidates`: number of candidates, or None for the number in the sensor's setting.
    - `capacity`: number of points to keep in the cloud.
    - `grid`: grid of the samples, or None for the grid of the task.
    - `rays`: number of rays along each side of an image, or None for the sensor's own numbers.
    """

    samples: int
    candidates: int | None
    capacity: int
    grid: Grid | None = None
    rays: int | None = None


USUAL, QUICK = Sizes(16, None, 8192), Sizes(4, 40, 1024, Grid(56), 24)
DEMO = Sizes(16, 60, 2048)
# Maximum number of views of the baseline in the demo.
_RACE_VIEWS = 10


def rule(texts: Sequence[str]) -> StopRule | None:
    """Make a stop rule from texts such as "sure=0.95", or None for "never".

    The rule holds when one of the rules in the texts holds.

    **Raises:** `ValueError` if a name is unknown, or if a value is not a number or out of range.
    """
    if not texts or list(texts) == ["never"]:
        return None
    rules = []
    for text in texts:
        name, _, value = text.partition("=")
        require(name in STOPS, f"--until is {text!r}: give never or one of {', '.join(STOPS)}, such as sure=0.95")
        try:
            rules.append(STOPS[name].rule(float(value)))
        except (ValueError, OverflowError) as error:
            raise InputError(f"--until is {text!r} ({error}): give a number, such as {name}=0.95") from error
    return functools.reduce(operator.or_, rules)


def search_of(name: str, radius: float, count: int) -> Search:
    """Make the search with this name, one of `SEARCHES`.

    - `radius`: distance of the candidates in scene units.
    - `count`: number of candidates.
    """
    candidates = SphereCandidates(count, radius)
    if name == "tie-break":
        return TieBreakSearch(candidates, second=Coverage())
    return searches.search_of(name, candidates, count, radius, num_starts=6, iterations=20)


def imagined(model: str, quick: bool, known: str | ShapeBank | None) -> SurfaceSampler:
    """Make the sampler of imagined surfaces, with a bank of known shapes if given.

    - `model`: name of the model, one of `MODELS`.
    - `known`: name of a shipped bank, a folder of upright meshes, or a bank of parts in any rotation. None or "none"
      for no bank.

    **Raises:** `ValueError` if there is no such bank or folder, or if no mesh in the folder can be used.
    """
    sampler = SurfaceSampler.preset(model, quick=quick)
    if known is None or known == "none":
        return sampler
    if isinstance(known, ShapeBank):
        return sampler.with_bank(known, FreeRotation())
    if known in SHIPPED_BANKS:
        return sampler.with_bank(shape_bank(known), bank_poses(known))
    require(
        os.path.isdir(known),
        f"--known {known}: there is no such folder of meshes: give one, or {', '.join(SHIPPED_BANKS)} or none",
    )
    return sampler.with_bank(ShapeBank.from_meshes(known), Upright(by_axis=True))


def planner_of(
    setting: Setting, acquisition: Acquisition, search: str, sampler: SurfaceSampler, sizes: Sizes
) -> Planner:
    """Make the planner of a task, with the search of this name (one of `SEARCHES`)."""
    grid = sizes.grid or sampler.grid
    sampler = dataclasses.replace(sampler, grid=grid, num_samples=sizes.samples)
    searcher = search_of(search, setting.radius, sizes.candidates or setting.num_candidates)
    camera = setting.camera if sizes.rays is None else setting.camera.resized(sizes.rays, sizes.rays)
    return Planner(acquisition, searcher, camera, sampler, capacity=sizes.capacity)


def first_pose(place: Position, surface: Surface) -> Pose:
    """Return the pose of a first view at a position. The camera looks at the origin.

    **Raises:** `ValueError` for a position inside the object.
    """
    pose = look_at(place)
    require(not surface.contains(np.array([place]))[0], f"--first is {place}, inside the object: give a place outside")
    return pose


def play(options: EpisodeOptions, subject: Subject, setting: Setting, sizes: Sizes, until: Sequence[str] = ()) -> None:
    """Simulate an episode, print each view when it is finished, and write the episode and a report.

    - `subject`: the object, the acquisition and the first pose.
    - `setting`: the camera, and the distance and number of candidates.
    - `sizes`: sizes of the planner, unless `--quick` replaces them.
    - `until`: texts of stop rules, the default of `--until`. If there are any, the baseline farthest view also runs
      from the same first view for comparison.
    """
    began = time.perf_counter()
    if options.quick:
        typer.echo("--quick: small settings. Leave it out for the usual ones.")
        sizes = QUICK
    if subject.note:
        typer.echo(subject.note)
    bank = options.known or subject.bank
    if options.model == "paper":
        require(
            options.known in (None, "none"),
            f"--known {options.known}: the paper's model has no known shapes: leave it out, or give --model screened",
        )
        bank = "none"
    sampler = dataclasses.replace(imagined(options.model, options.quick, bank), grid=subject.grid or Grid())
    planner, rival = (
        planner_of(setting, subject.acquisition, search, sampler, sizes) for search in (options.search, "farthest")
    )
    folder, enough = options.out or Path("runs") / _folder_name(options, subject), rule(options.until or until)
    races = bool(until) and enough is not None and options.search != "farthest"
    key, noise = jax.random.key(options.seed), SensorNoise(options.noise, options.noise)
    lines = Lines(planner)
    sketches = (
        viz.Sketches(Episode(planner, subject.surface, noise, subject.first, key, ())) if options.report else None
    )
    race: Future[Episode] | None = None
    drawing: Future[None] | None = None

    # Drawing and the baseline run in the background while the next view is planned.
    def report_step(step: Step) -> None:
        nonlocal race, drawing
        lines(step.view)
        if sketches is not None:
            # Draw only one step at a time, because each step that waits to be drawn keeps its posterior in memory.
            if drawing is not None:
                drawing.result()
            drawing = in_background(sketches.add, step)
        # Start the baseline only after the first view. Before, both threads would compile the same programs.
        if race is None and races:
            start = subject.surface, subject.first, _RACE_VIEWS, key, noise, folder / "farthest"
            race = in_background(simulate, rival, *start, progress=False, until=enough)

    start = subject.surface, subject.first, options.views, key, noise, folder
    episode = simulate(planner, *start, until=enough, each=report_step)
    rival_episode = None if race is None else race.result()
    if drawing is not None:
        drawing.result()
    if episode.stop_reason is not None:
        views, saved = len(episode.views), options.views - len(episode.views)
        typer.echo(f"enough   after view {views}: {episode.stop_reason}. Views saved: {saved} of {options.views}")
    if rival_episode is not None:
        words = race_words(rival_episode, episode)
        typer.echo(textwrap.fill(words, 100, initial_indent="race     ", subsequent_indent="         "))
    if options.report:
        page = viz.write_report(
            episode,
            folder,
            title=subject.name,
            rival=rival_episode,
            sketches=sketches,
            question=subject.question,
        )
        typer.echo(f"report   {page}")
    typer.echo(f"episode  {folder}   ({time.perf_counter() - began:.0f} s)")


def _folder_name(options: EpisodeOptions, subject: Subject) -> str:
    model = () if options.model == "screened" else (options.model,)
    parts = subject.name, options.task, options.search, *model, f"seed{options.seed}"
    return re.sub(r"[^A-Za-z0-9_.-]", "_", "-".join(parts))
