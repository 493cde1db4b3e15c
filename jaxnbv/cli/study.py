"""`jaxnbv study NAME`: the runs behind the paper's tables and figures."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from jaxnbv.cli import actions, options
from jaxnbv.cli.registry import Device
from jaxnbv.studies.registry import STUDIES, Entry, flag

StudyName = StrEnum("StudyName", {name.upper(): name for name in STUDIES})  # type: ignore[misc]
NameArgument = Annotated[
    StudyName, typer.Argument(metavar="NAME", help=f"Which: {', '.join(STUDIES)}.", show_default=False)
]
FolderArgument = Annotated[Path | None, typer.Argument(help="A recording, for recorded.", show_default=False)]


def study(
    name: NameArgument,
    folder: FolderArgument = None,
    scenes: options.ScenesOption = None,
    views: options.StudyViewsOption = None,
    methods: options.MethodsOption = None,
    own: options.OwnOption = None,
    model: options.StudyModelOption = None,
    meshes: options.MeshesOption = None,
    classifier: options.CheckpointOption = None,
    framing: options.StudyFramingOption = None,
    first: options.StudyFirstOption = None,
    box: options.BoxOption = None,
    up: options.UpOption = None,
    out: options.StudyOutOption = None,
    quick: options.StudyQuickOption = False,
    workers: options.WorkersOption = 1,
    scheduler: options.SchedulerOption = None,
    device: options.DeviceOption = Device.AUTO,
) -> None:
    actions.study(**locals())


def _about(name: str, entry: Entry) -> str:
    taken = ", ".join([f"{entry.scenes} scenes, {entry.views} views", *map(flag, entry.options)])
    return f"**{name}** ({taken}): {entry.question} {entry.settings}"


study.__doc__ = "\n\n".join(
    [
        "Measure a claim of the paper on many scenes, with the same scenes, first views and noise for all methods.",
        "Writes a record a scene, tables, figures and pictures. Interrupted, it continues with the next scene.",
        *(_about(name, entry) for name, entry in STUDIES.items()),
    ]
)
