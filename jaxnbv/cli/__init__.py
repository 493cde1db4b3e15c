"""The command line. Its commands are the entry points `jaxnbv.commands`: functions or `typer.Typer` apps."""

import sys
from importlib.metadata import EntryPoint, entry_points
from typing import Annotated

import typer

import jaxnbv
from jaxnbv.cli.background import end_process, is_working
from jaxnbv.cli.options import Command
from jaxnbv.cli.streams import each_warning_once, write_readable
from jaxnbv.compiled import keep_compiled
from jaxnbv.errors import InputError, explained_imports

app = typer.Typer(
    help="""Where should the sensor look next, for what you want to know?

    jaxnbv scans an object from a first view, imagines its unseen surface, and picks the view with the highest expected
    value. Then it scans from there and repeats. Each run writes a folder with the episode (poses, scans, values of all
    candidates), the point cloud as PLY, and a report.html that opens offline.

    Try `jaxnbv demo`, then `jaxnbv run MESH --views 5 --out runs/mine`.
    """,
    epilog="To continue an interrupted run after its last finished view or scene, repeat its command.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    add_completion=False,
    pretty_exceptions_enable=False,
)


def _show_version(is_set: bool) -> bool:
    if is_set:
        typer.echo(f"jaxnbv {jaxnbv.__version__}")
        raise typer.Exit
    return is_set


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Keep compiled programs on disk, before any command runs."""
    try:
        keep_compiled()
    except InputError as error:
        typer.echo(f"warning: {error}", err=True)


def _is_own(point: EntryPoint) -> bool:
    return point.module.split(".")[0] == "jaxnbv"


def _add_commands() -> None:
    """Add the commands of this package, then the commands of other packages.

    A command of another package is skipped if this package has a command of the same name.
    """
    named = {point.name: point for point in sorted(entry_points(group="jaxnbv.commands"), key=_is_own)}
    for point in sorted(named.values(), key=lambda point: (not _is_own(point), point.name)):
        try:
            loaded = point.load()
            if isinstance(loaded, typer.Typer):
                app.add_typer(loaded, name=point.name)
            else:
                app.command(point.name, cls=Command)(loaded)
        # Importing a module of another package can raise any error.
        except (Exception, SystemExit) as error:
            package = point.dist.name if point.dist else point.module
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            typer.echo(f"warning: {package} has no command {point.name} ({reason}): fix it or uninstall it", err=True)


_add_commands()


def run_app() -> None:
    """Run the command line and raise `SystemExit`. An `InputError` is printed without a traceback."""
    write_readable()
    try:
        with explained_imports(), each_warning_once():
            app()
    except InputError as error:
        typer.echo(f"error: {error}", err=True)
        sys.exit(2)


def main() -> None:
    """Entry point: run the command line, then end the process even if a background thread still runs."""
    try:
        run_app()
    except SystemExit as end:
        if is_working():
            end_process(end.code if isinstance(end.code, int) else 0)
        raise
