"""`jaxnbv session ...`: what a real sensor saw."""

from pathlib import Path
from types import SimpleNamespace
from typing import Annotated

import typer

from jaxnbv.cli import actions, options
from jaxnbv.cli.registry import Device

session = typer.Typer(
    help="What a real sensor saw, as `jaxnbv.Session` keeps it.", no_args_is_help=True, rich_markup_mode="markdown"
)

OutOption = Annotated[
    Path | None,
    options.running(metavar="DIR", help="Output folder; a session of its own.", show_default="DIR-TASK-SEARCH"),
]
SourceOption = Annotated[
    str | None,
    options.asking(
        metavar="X,Y,Z",
        help="For heat: the point of the object that is heated, in world units.",
        show_default="the middle of the first image",
    ),
]


@session.command()
def replay(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="The folder of a session.")],
    task: options.TaskOption = options.COVERAGE,
    network: options.NetworkOption = None,
    category: options.CategoryOption = None,
    source: SourceOption = None,
    search: options.SearchOption = options.DISCRETE,
    model: options.ModelOption = options.SCREENED,
    known: options.KnownOption = None,
    out: OutOption = None,
    quick: options.QuickOption = False,
    report: options.ReportOption = True,
    device: options.DeviceOption = Device.AUTO,
) -> None:
    """Plan a session again, for another task: where would it have looked next after each image?

    Images, poses and box are the session's, and so are the poses to choose among, if it proposed any.
    """
    actions.replay(SimpleNamespace(**locals()))


@session.callback()
def _sessions() -> None:
    """So that `replay` is a command of its own, though it is the only one."""
