"""`jaxnbv view RUN`: shows an episode or a session in the browser."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

import jaxnbv as nbv
from jaxnbv.cli.options import command


@dataclass(frozen=True, kw_only=True)
class ViewOptions:
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run or a session.")]
    html: Annotated[Path | None, typer.Option(help="Write the scene to an HTML file that opens offline, and exit.")] = (
        None
    )
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the page.")] = 8080


@command(ViewOptions)
def view(options: ViewOptions) -> None:
    """Look at a run or a session in the browser: points, cameras, surfaces and the next view."""
    from jaxnbv.checks import check_device

    check_device()
    is_session = (options.folder / "session.json").exists()
    run = nbv.Session.load(options.folder) if is_session else nbv.Episode.load(options.folder)
    page = nbv.viz.LiveView(options.port)
    try:
        page.update(run)
        if options.html is not None:
            typer.echo(f"page     {page.save(options.html)}")
            return
        typer.echo(f"look at {page.address}; end with Ctrl-C")
        while True:
            time.sleep(3600.0)
    except KeyboardInterrupt:
        typer.echo("ended")
    finally:
        page.stop()
