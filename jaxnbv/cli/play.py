"""Simulates an episode for a command: makes the planner, runs a baseline for comparison, and writes the results."""

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
from jaxnbv.cli.lines import ViewPrinter
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
from jaxnbv.viz.task import rival_text


class Sizes(NamedTuple):
    """Settings of a planner that decide how long a step takes.

    - `samples`: number of imagined surfaces.
    - `candidates`: number of candidate poses; None for that of the task's `Setting`.
    - `capacity`: number of points to keep in the cloud.
    - `grid`: grid of the imagined surfaces; None for the sampler's.
    - `rays`: number of rays along each side of an image; None for those of the task's camera.
    """

    samples: int
    candidates: int | None
    capacity: int
    grid: Grid | None = None
    rays: int | None = None


USUAL, QUICK = Sizes(16, None, 8192), Sizes(4, 40, 1024, Grid(56), 24)
DEMO = Sizes(16, 60, 2048)
# Maximum number of views of the baseline in the demo.
_MAX_RIVAL_VIEWS = 10


def stop_rule_of(texts: Sequence[str]) -> StopRule | None:
    """Return the stop rule for the values of `--until`, such as "sure=0.95"; None for "never" or no value.

    The rule holds as soon as one of the values does.

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
    """Make the search `name` of `SEARCHES`, over `count` candidates at distance `radius` from the origin."""
    candidates = SphereCandidates(count, radius)
    if name == "tie-break":
        return TieBreakSearch(candidates, second=Coverage())
    return searches.search_of(name, candidates, count, radius, num_starts=6, iterations=20)


def sampler_of(model: str, quick: bool, bank: str | ShapeBank | None) -> SurfaceSampler:
    """Make the sampler of imagined surfaces, with or without a bank of known shapes.

    - `model`, `quick`: as in `SurfaceSampler.preset`.
    - `bank`: name of a shipped bank, a folder of upright meshes, or a bank of parts in any rotation. None or "none"
      for no bank.

    **Raises:** `ValueError` if there is no such bank or folder, or if no mesh in the folder can be used.
    """
    sampler = SurfaceSampler.preset(model, quick=quick)
    if bank is None or bank == "none":
        return sampler
    if isinstance(bank, ShapeBank):
        return sampler.with_bank(bank, FreeRotation())
    if bank in SHIPPED_BANKS:
        return sampler.with_bank(shape_bank(bank), bank_poses(bank))
    require(
        os.path.isdir(bank),
        f"--known {bank}: there is no such folder of meshes: give one, or {', '.join(SHIPPED_BANKS)} or none",
    )
    return sampler.with_bank(ShapeBank.from_meshes(bank), Upright(by_axis=True))


def planner_of(
    setting: Setting, acquisition: Acquisition, search: str, sampler: SurfaceSampler, sizes: Sizes
) -> Planner:
    grid = sizes.grid or sampler.grid
    sampler = dataclasses.replace(sampler, grid=grid, num_samples=sizes.samples)
    searcher = search_of(search, setting.radius, sizes.candidates or setting.num_candidates)
    camera = setting.camera if sizes.rays is None else setting.camera.resized(sizes.rays, sizes.rays)
    return Planner(acquisition, searcher, camera, sampler, capacity=sizes.capacity)


def first_pose(place: Position, surface: Surface) -> Pose:
    """Return the pose of a first view that looks from a place (scene coordinates) at the origin.

    **Raises:** `ValueError` for a position inside the object.
    """
    pose = look_at(place)
    require(not surface.contains(np.array([place]))[0], f"--first is {place}, inside the object: give a place outside")
    return pose


def check_options(options: EpisodeOptions, until: Sequence[str] = ()) -> StopRule | None:
    """Check options early, before the object and the known shapes are made. Return the stop rule.

    - `until`: default of `--until`.

    **Raises:** `ValueError` for fewer than one view, an invalid stop rule, or known shapes for the paper's model.
    """
    require(options.views >= 1, f"asked for {options.views} views; ask for at least one")
    stop_rule = stop_rule_of(options.until or until)
    require(
        options.model != "paper" or options.known in (None, "none"),
        f"--known {options.known}: the paper's model has no known shapes: leave it out, or give --model screened",
    )
    return stop_rule


def run_episode(
    options: EpisodeOptions,
    subject: Subject,
    setting: Setting,
    sizes: Sizes,
    stop_rule: StopRule | None,
    has_rival: bool = False,
) -> None:
    """Simulate an episode, print each view when it is finished, and write the episode and a report.

    - `setting`: the camera, and distance and number of the candidates.
    - `sizes`: numbers of samples, candidates, points and rays. With `--quick`, `QUICK` replaces them.
    - `has_rival`: whether to run the baseline farthest view too, from the same first view, until the stop rule holds.
      Without a stop rule the baseline is not run.
    """
    start_time = time.perf_counter()
    if options.quick:
        typer.echo("--quick: small settings. Leave it out for the usual ones.")
        sizes = QUICK
    if subject.note:
        typer.echo(subject.note)
    bank = "none" if options.model == "paper" else options.known or subject.bank
    sampler = dataclasses.replace(sampler_of(options.model, options.quick, bank), grid=subject.grid or Grid())
    names = options.search, "farthest"
    planner, rival = (planner_of(setting, subject.acquisition, name, sampler, sizes) for name in names)
    folder = options.out or Path("runs") / _folder_name(options, subject)
    has_rival = has_rival and stop_rule is not None and options.search != "farthest"
    key, noise = jax.random.key(options.seed), SensorNoise(options.noise, options.noise)
    print_view = ViewPrinter(planner)
    start = Episode(planner, subject.surface, noise, subject.first, key, ())
    sketches = viz.Sketches(start) if options.report else None
    rival_run: Future[Episode] | None = None
    sketch_run: Future[None] | None = None

    # Drawing and the baseline run in the background while the next view is planned.
    def report_step(step: Step) -> None:
        nonlocal rival_run, sketch_run
        print_view(step.view)
        if sketches is not None:
            # Draw only one step at a time, because each step that waits to be drawn keeps its posterior in memory.
            if sketch_run is not None:
                sketch_run.result()
            sketch_run = in_background(sketches.add, step)
        # Start the baseline only after the first view. Earlier, both threads would compile the same programs.
        if rival_run is None and has_rival:
            rival_settings = subject.surface, subject.first, _MAX_RIVAL_VIEWS, key, noise, folder / "farthest"
            rival_run = in_background(simulate, rival, *rival_settings, progress=False, until=stop_rule)

    settings = subject.surface, subject.first, options.views, key, noise, folder
    episode = simulate(planner, *settings, until=stop_rule, each=report_step)
    rival_episode = None if rival_run is None else rival_run.result()
    if sketch_run is not None:
        sketch_run.result()
    if episode.stop_reason is not None:
        views, saved = len(episode.views), options.views - len(episode.views)
        typer.echo(f"enough   after view {views}: {episode.stop_reason}. Views saved: {saved} of {options.views}")
    if rival_episode is not None:
        text = rival_text(rival_episode, episode)
        typer.echo(textwrap.fill(text, 100, initial_indent="race     ", subsequent_indent="         "))
    if options.report:
        page = viz.write_report(
            episode, folder, title=subject.name, rival=rival_episode, sketches=sketches, question=subject.question
        )
        typer.echo(f"report   {page}")
    typer.echo(f"episode  {folder}   ({time.perf_counter() - start_time:.0f} s)")


def _folder_name(options: EpisodeOptions, subject: Subject) -> str:
    model = () if options.model == "screened" else (options.model,)
    parts = subject.name, options.task, options.search, *model, f"seed{options.seed}"
    return re.sub(r"[^A-Za-z0-9_.-]", "_", "-".join(parts))
