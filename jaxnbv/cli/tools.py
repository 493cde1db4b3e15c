"""`jaxnbv view`: a run in the browser. `jaxnbv report`: what studies have found."""

from pathlib import Path
from typing import Annotated

import typer

from jaxnbv.cli import actions


def view(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="The folder of a run or of a session.")],
    html: Annotated[
        Path | None, typer.Option(help="Write the scene into one HTML file, which opens offline, and end.")
    ] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Where the page is served.")] = 8080,
) -> None:
    """Look at a run in the browser: points, cameras, the surface, what is imagined, where to look next.

    Needs viser: `pip install ".[view]"` in a clone. Surfaces are those of the usual model, given what was seen.
    """
    actions.view(folder, html, port)


def report(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="A folder of studies, or one in which such folders lie.")
    ],
    out: Annotated[Path | None, typer.Option(help="The page, an HTML file.", show_default="DIR/report.html")] = None,
) -> None:
    """Gather studies on one page: tables, figures, pictures, settings, versions and times. Nothing is run."""
    actions.report(folder, out or folder / "report.html")
