"""`jaxnbv session ...`: what a real sensor saw."""

from pathlib import Path
from typing import Annotated, Any

import typer

from jaxnbv.cli import actions
from jaxnbv.cli.asked import Device
from jaxnbv.cli.options import (
    REQUIRED,
    CategoryOption,
    DeviceOption,
    KnownOption,
    ModelName,
    ModelOption,
    NetworkOption,
    QuickOption,
    ReportOption,
    SearchName,
    SearchOption,
    Task,
    TaskOption,
    command,
)

session = typer.Typer(
    help="What a real sensor saw, as `jaxnbv.Session` keeps it.", no_args_is_help=True, rich_markup_mode="markdown"
)

FolderArgument = Annotated[Path, typer.Argument(metavar="DIR", help="The folder of a session.")]
OutOption = Annotated[
    Path | None, typer.Option(help="Output folder; a session of its own.", show_default="DIR-TASK-SEARCH")
]
SourceOption = Annotated[
    str | None,
    typer.Option(
        help="Where the object is heated, for heat: x,y,z of a point on it, in world units.",
        show_default="the middle of the first image",
    ),
]


def _replay(device: Device, **given: Any) -> None:
    actions.prepare(device)
    actions.replay(**given)


session.command("replay")(
    command(
        _replay,
        """Plan a session again, for another task: where would it have looked next after each image?

        Images, poses and box are the session's, and so are the poses to choose among, if it proposed any.
        """,
        {
            "folder": (FolderArgument, REQUIRED),
            "task": (TaskOption, Task("coverage")),
            "network": (NetworkOption, None),
            "category": (CategoryOption, None),
            "source": (SourceOption, None),
            "search": (SearchOption, SearchName("discrete")),
            "model": (ModelOption, ModelName("screened")),
            "known": (KnownOption, None),
            "out": (OutOption, None),
            "quick": (QuickOption, False),
            "report": (ReportOption, True),
            "device": (DeviceOption, Device.AUTO),
        },
    )
)


@session.callback()
def _sessions() -> None:
    """So that `replay` is a command of its own, though it is the only one."""
