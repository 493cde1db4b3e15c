"""`jaxnbv view RUN`: a look at an episode."""

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from jaxnbv.cli.episode import KnownOption
from jaxnbv.cli.options import command


@dataclass(frozen=True, kw_only=True)
class ViewOptions:
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="The folder of a run.")]
    html: Annotated[
        Path | None, typer.Option(help="Write the scene into one HTML file, which opens offline, and end.")
    ] = None
    known: KnownOption = None
    port: Annotated[int, typer.Option(min=0, max=65535, help="Where the page is served.")] = 8080


@command(ViewOptions)
def view(options: ViewOptions) -> None:
    """Look at a run in the browser: points, cameras, the surface, what is imagined, where to look next.

    Surfaces are those of the usual model given what was seen, by one who knows shapes with --known.
    """
    from jaxnbv.checks import check_device

    check_device()
    from jaxnbv.cli.play import imagined
    from jaxnbv.planning.episode import Episode
    from jaxnbv.viz import LiveView

    episode, page = Episode.load(options.folder), LiveView(options.port)
    try:
        if options.known is not None:
            planner = dataclasses.replace(episode.planner, sampler=imagined("screened", False, options.known))
            episode = dataclasses.replace(episode, planner=planner)
        page.update(episode)
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
