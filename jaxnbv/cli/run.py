"""`jaxnbv run MESH`: simulates an episode on a user's mesh."""

from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from jaxnbv.cli.episode import EpisodeOptions, SearchOption, TaskOption
from jaxnbv.cli.options import command, sensor_option
from jaxnbv.cli.tasks import TASKS
from jaxnbv.cli.tasks.base import Task, default_first_pose
from jaxnbv.errors import InputError


@dataclass(frozen=True, kw_only=True)
class RunOptions(EpisodeOptions):
    mesh: Annotated[
        Path, typer.Argument(metavar="MESH", help="Any mesh that trimesh reads: OBJ, PLY, STL, OFF, glTF, ...")
    ]
    task: TaskOption = "coverage"
    search: SearchOption = "discrete"
    up: Annotated[
        str, sensor_option(metavar="AXIS", help="Upward axis of the mesh: x, y or z, or one of these with a -.")
    ] = "y"
    paper: Annotated[
        bool,
        sensor_option(
            "--paper",
            help="The paper's camera, which sees a patch of the mesh: 30 degrees wide, and 2 to 3 scene units away, "
            "depending on the task.",
        ),
    ] = False


_TASK_OPTIONS = {
    name: hint
    for task in TASKS.values()
    for name, hint in get_type_hints(task, include_extras=True).items()
    if name in {field.name for field in fields(task)}
}
"""Annotations of the options that belong to tasks, keyed by option. Each task has only some of them."""


@command(RunOptions, _TASK_OPTIONS)
def run(options: RunOptions, **task_options: Any) -> None:
    """Choose views of a mesh, scanned by a simulated depth camera.

    The mesh may be open, a soup of triangles or inconsistently wound. It is scaled and centred so that its longest side
    is 2.5 scene units. Without --paper, cameras stand far enough from the centre to see the whole mesh.
    """
    task = _task(options.task, {name: value for name, value in task_options.items() if value is not None})

    from jaxnbv.checks import check_device

    check_device()
    from jaxnbv.cli.play import USUAL, check_options, first_pose, run_episode
    from jaxnbv.cli.tasks.base import Subject
    from jaxnbv.scanning import load_mesh
    from jaxnbv.scanning.sensors import fit_distance

    stop_rule = check_options(options)
    surface, setting = load_mesh(options.mesh, options.up), task.setting()
    if not options.paper:
        setting = fit_distance(setting, surface.bounding_radius)
    default_pose = default_first_pose(None if options.paper else setting.radius)
    first = default_pose if options.first is None else first_pose(options.first, surface)
    acquisition = task.acquisition(surface, setting.camera, first)
    subject = Subject(options.mesh.stem, surface, acquisition, first, task.bank(surface))
    run_episode(options, subject, setting, USUAL, stop_rule)


def _task(name: str, settings: dict[str, Any]) -> Task:
    """Make a task from the options that the user gave.

    **Raises:** `ValueError` for an option that the task does not have, or if an option that it requires is missing.
    """
    declared = {field.name: field for field in fields(TASKS[name])}
    for option in settings.keys() - declared.keys():
        takers = ", ".join(other for other, task in TASKS.items() if option in {field.name for field in fields(task)})
        raise InputError(f"--task {name} takes no --{option}: it is for {takers}")
    for option in declared.keys() - settings.keys():
        if declared[option].default is MISSING:
            raise InputError(f"--task {name} needs --{option}")
    return TASKS[name](**settings)
