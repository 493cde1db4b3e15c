"""The command line: `jaxnbv demo`, `jaxnbv run MESH`, `jaxnbv view RUN`, `jaxnbv study NAME`, `jaxnbv report DIR`."""

import os
import sys
from typing import Annotated

import platformdirs
import typer

import jaxnbv
from jaxnbv.cli.episode import demo, run, view
from jaxnbv.cli.report import report
from jaxnbv.cli.study import study
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


for _command in (demo, run, view, report, study):
    app.command()(_command)


def keep_programs() -> None:
    """Keep what JAX compiles, once it is imported, for later runs and for processes that this one starts."""
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(platformdirs.user_cache_path("jaxnbv") / "xla")
        os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"


def main() -> None:
    """Entry point: errors that the user can mend are one line, without a traceback."""
    keep_programs()
    try:
        with explained_imports():
            app()
    except InputError as error:
        typer.echo(f"error: {error}", err=True)
        sys.exit(2)
