"""The command line. Commands are entry points of the group `jaxnbv.commands`, functions for typer by their names."""

import sys
from importlib.metadata import EntryPoint, entry_points
from typing import Annotated

import typer

import jaxnbv
from jaxnbv.cli.background import end_process, is_working
from jaxnbv.cli.options import Command
from jaxnbv.cli.streams import write_readable
from jaxnbv.compiled import keep_compiled
from jaxnbv.errors import InputError, explained_imports

app = typer.Typer(
    help="""Where should the sensor look next, for what you want to know?

    jaxnbv scans an object from a first view, imagines what it may look like where it was not seen, and picks the view
    that is expected to tell the most; then it scans from there and asks again. Each run leaves a folder with the
    episode (poses, scans, the values of all candidates), its point cloud as PLY, and a report.html that opens offline.

    Try `jaxnbv demo`, then `jaxnbv run MESH --views 5 --out runs/mine`.
    """,
    epilog="A run that was interrupted continues with the same command after its last finished view or scene.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    add_completion=False,
    pretty_exceptions_enable=False,
)


def _show_version(asked: bool) -> bool:
    if asked:
        typer.echo(f"jaxnbv {jaxnbv.__version__}")
        raise typer.Exit
    return asked


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """What is asked of `jaxnbv` itself."""
    try:
        keep_compiled()
    except InputError as error:
        typer.echo(f"warning: {error}", err=True)


def _is_own(point: EntryPoint) -> bool:
    return point.module.split(".")[0] == "jaxnbv"


def _add_commands() -> None:
    """Add the commands of this package, then those of others under names that are free."""
    named = {point.name: point for point in sorted(entry_points(group="jaxnbv.commands"), key=_is_own)}
    for point in sorted(named.values(), key=lambda point: (not _is_own(point), point.name)):
        try:
            app.command(point.name, cls=Command)(point.load())
        # Whatever a module of somebody else does as it is imported.
        except (Exception, SystemExit) as error:
            package = point.dist.name if point.dist else point.module
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            typer.echo(f"warning: {package} has no command {point.name} ({reason}): mend it or uninstall it", err=True)


_add_commands()


def answer() -> None:
    """Answer the words of this process: errors that the user can mend are one line, without a traceback.

    **Raises:** `SystemExit` with the code.
    """
    write_readable()
    try:
        with explained_imports():
            app()
    except InputError as error:
        typer.echo(f"error: {error}", err=True)
        sys.exit(2)


def main() -> None:
    """Entry point: answer, then end the process, whatever still runs beside."""
    try:
        answer()
    except SystemExit as leaving:
        if is_working():
            end_process(leaving.code if isinstance(leaving.code, int) else 0)
        raise
