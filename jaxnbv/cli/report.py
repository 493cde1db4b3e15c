"""`jaxnbv report DIR`: writes one page with the results of studies."""

from pathlib import Path
from typing import Annotated

import typer


def report(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Folder of a study, or a folder that contains such folders.")
    ],
    out: Annotated[Path | None, typer.Option(help="Output page, an HTML file.", show_default="DIR/report.html")] = None,
) -> None:
    """Gather studies on one page: tables, figures, pictures, settings, versions, times. Runs nothing."""
    from jaxnbv.studies.engine.page import write_page

    typer.echo(f"{write_page(folder, out or folder / 'report.html')}")
