"""What `jaxnbv demo` and `jaxnbv run MESH` do: one episode."""

import dataclasses
import time
from pathlib import Path

import jax
import typer

from jaxnbv.acquisition import Acquisition
from jaxnbv.checks import InputError, require
from jaxnbv.cli.actions.lines import Lines
from jaxnbv.cli.actions.run_folder import clear, explained, note, usual_folder
from jaxnbv.cli.actions.sensors import first_pose, peculiarities, quick_rays, sensor_for
from jaxnbv.cli.actions.tasks import CommandTask, Given, OfMesh
from jaxnbv.cli.actions.until import rule
from jaxnbv.cli.asked import USUAL_SIZE, EpisodeOptions, SensorOptions, SizeOptions
from jaxnbv.cli.registry import SEARCHES, TASKS, resolve
from jaxnbv.geometry.pose import Pose
from jaxnbv.imagination import Imagination
from jaxnbv.planning.episode import View, simulate
from jaxnbv.planning.planner import Planner
from jaxnbv.scanning import Grid, SensorNoise, Surface, load_mesh
from jaxnbv.scanning.sensors import Setting
from jaxnbv.storage.folders import AnotherConfigurationError
from jaxnbv.studies.scenes import Framing
from jaxnbv.studies.scenes.banks import BANKS, bank_poses, shape_bank
from jaxnbv.surfaces import ShapeBank, Upright
from jaxnbv.viz import write_report


def demo(task: str, scene: int, framing: Framing, first: str | None, options: EpisodeOptions) -> None:
    """One episode of a shipped object.

    **Raises:** `ValueError` for a first view from inside the object.
    """
    made: CommandTask = resolve(TASKS[task].task)
    shown = made.demo(scene, framing, options.seed)
    if shown.note:
        typer.echo(shown.note)
    start = shown.first if first is None else first_pose(first, shown.surface)
    setting = quick_rays(made.setting) if options.quick else made.setting
    # The paper's model knows no shapes.
    usual = None if options.model == "paper" else shown.bank
    known = usual if options.known is None else options.known
    plain = Imagination.preset(options.model, shown.longest_side, options.quick, solid=shown.solid)
    imagination = dataclasses.replace(knowing(plain, known), grid=shown.grid)
    planner = planner_of(setting, shown.acquisition, options.search, imagination, options.quick)
    _run(shown.name, task, shown.surface, planner, start, options, shown.until)


def run(
    mesh: Path,
    task: str,
    network: Path | None,
    category: str | None,
    source: str | None,
    first: str | None,
    sensor: SensorOptions,
    sizes: SizeOptions,
    options: EpisodeOptions,
) -> None:
    """One episode of a mesh of the user's.

    **Raises:** `ValueError` for a task without what it needs, or with what it has no use for, a sensor that cannot see
    the object, and a first view from inside it.
    """
    surface, made = load_mesh(mesh), task_for(task, network, category, source)
    setting = sensor_for(surface, made.setting, sensor, options.quick)
    start = first_pose(first, surface, None if sensor.paper else setting.radius)
    acquisition = made.acquisition(Given(OfMesh(surface, start, setting.camera), network, category, source))
    plain = Imagination.preset(options.model, quick=options.quick, lengthscale=sizes.lengthscale)
    imagination = knowing(plain, options.known)
    planner = planner_of(setting, acquisition, options.search, imagination, options.quick, sizes)
    for words in peculiarities(mesh, surface, planner.imagination.grid.spacing):
        typer.echo(f"note     {words}")
    _run(mesh.stem, task, surface, planner, start, options)


def knowing(imagination: Imagination, known: str | None) -> Imagination:
    """One that knows the shapes of a bank that ships, or upright ones of a folder of meshes; none of None or "none".

    **Raises:** `ValueError` if there is no such bank or folder, or no mesh in it that can be used.
    """
    if known in (None, "none"):
        return imagination
    if known in BANKS:
        return imagination.knowing(shape_bank(known), bank_poses(known))
    require(
        Path(known).is_dir(), f"--known {known}: there is no such folder of meshes; or give {', '.join(BANKS)}, none"
    )
    return imagination.knowing(ShapeBank.from_meshes(known), Upright(by_axis=True))


def task_for(task: str, network: Path | None, category: str | None, source: str | None) -> CommandTask:
    """The task of a name.

    **Raises:** `ValueError` if it lacks what it needs, or was given what it has no use for.
    """
    given = {"network": network, "category": category, "source": source}
    for option, value in given.items():
        takers = ", ".join(name for name, entry in TASKS.items() if option in entry.options)
        useless = value is not None and option not in TASKS[task].options
        require(not useless, f"--task {task} takes no --{option}: it is for {takers}")
    for option, hint in TASKS[task].requires:
        require(given[option] is not None, f"--task {task} needs {hint}")
    made: CommandTask = resolve(TASKS[task].task)
    return made


def planner_of(
    setting: Setting,
    acquisition: Acquisition,
    search: str,
    imagination: Imagination,
    quick: bool,
    sizes: SizeOptions = USUAL_SIZE,
) -> Planner:
    """At the authors' settings, or at small ones."""
    grid, usual = (Grid(56), 4) if quick else (imagination.grid, 16)
    imagination = dataclasses.replace(imagination, grid=grid, num_samples=sizes.samples or usual)
    # A gradient search looks at its own number of candidates before it climbs.
    count = 40 if quick else None if search.startswith("gradient") else setting.num_candidates
    found = resolve(SEARCHES[search].search)(setting.radius, sizes.candidates or count)
    return Planner(acquisition, found, setting.camera, imagination, capacity=1024 if quick else 8192)


def _run(
    name: str,
    task: str,
    scene: Surface,
    planner: Planner,
    first: Pose,
    options: EpisodeOptions,
    until: tuple[str, ...] = (),
) -> None:
    enough, start = rule(options.until or until), time.perf_counter()
    folder = options.out or usual_folder(name, task, options.search, options.model, options.seed)
    if options.quick:
        typer.echo("--quick: small settings; leave it out for the paper's.")
    if options.overwrite:
        clear(folder)
    lines = Lines(planner)

    def tell(view: View) -> None:
        if lines.count == 0:
            note(folder, options.asked)
        lines(view)

    key, noise = jax.random.key(options.seed), SensorNoise(options.noise, options.noise)
    try:
        episode = simulate(planner, scene, first, options.views, key, noise, folder, until=enough, each=tell)
    except AnotherConfigurationError as error:
        raise InputError(explained(folder, options.asked, error)) from error
    if episode.stopped is not None:
        saved = options.views - len(episode.views)
        views = "view is" if saved == 1 else "views are"
        typer.echo(
            f"enough   after view {len(episode.views)}: {episode.stopped}. {saved} of {options.views} {views} saved"
        )
    if options.report:
        typer.echo(f"report   {write_report(episode, folder, title=name)}")
    typer.echo(f"episode  {folder}   ({time.perf_counter() - start:.0f} s)")
