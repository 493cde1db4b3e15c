"""What `jaxnbv view` does."""

import time
from pathlib import Path

import typer

from jaxnbv.cli.actions.device import prepare
from jaxnbv.cli.registry import Device
from jaxnbv.planning.replay import stored_run
from jaxnbv.viz.live import LiveView


def view(folder: Path, html: Path | None, port: int) -> None:
    """Show a stored run in the browser until it is interrupted, or write it into a file."""
    prepare(Device.AUTO)
    run = stored_run(folder)
    page = LiveView(port)
    try:
        page.update(*run)
        if html is not None:
            typer.echo(f"page     {page.save(html)}")
            return
        typer.echo(f"look at {page.address}; end with Ctrl-C")
        while True:
            time.sleep(3600.0)
    except KeyboardInterrupt:
        typer.echo("ended")
    finally:
        page.stop()
