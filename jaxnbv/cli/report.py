"""`jaxnbv report DIR`: studies on one page."""

from pathlib import Path
from typing import Annotated

import typer


def report(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="A folder of studies, or one in which such folders lie.")
    ],
    out: Annotated[Path | None, typer.Option(help="The page, an HTML file.", show_default="DIR/report.html")] = None,
) -> None:
    """Gather studies on one page: tables, figures, pictures, settings, versions and times. Nothing is run."""
    from jaxnbv.studies.engine.page import write_page

    typer.echo(f"{write_page(folder, out or folder / 'report.html')}")
