"""`jaxnbv convert`: checkpoints."""

from pathlib import Path
from typing import Annotated

import typer

from jaxnbv.cli import actions


def convert(
    source: Annotated[Path, typer.Argument(help="A PointNet++ network saved by PyTorch, .pth or .pt.")],
    target: Annotated[Path, typer.Argument(help="The .safetensors file to write.")],
) -> None:
    """Rewrite a PyTorch checkpoint as safetensors. Nothing in it is run, and PyTorch is not needed."""
    actions.convert(source, target)
