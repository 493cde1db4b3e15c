"""`jaxnbv report`: what studies have found."""

from pathlib import Path
from typing import Annotated

import typer

from jaxnbv.cli import actions


def report(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="A folder of studies, or one in which such folders lie.")
    ],
    out: Annotated[Path | None, typer.Option(help="The page, an HTML file.", show_default="DIR/report.html")] = None,
) -> None:
    """Gather studies on one page: tables, figures, pictures, settings, versions and times. Nothing is run."""
    actions.report(folder, out or folder / "report.html")
