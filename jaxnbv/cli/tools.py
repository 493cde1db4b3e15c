"""`jaxnbv convert`: checkpoints."""

from pathlib import Path
from typing import Annotated

import typer

from jaxnbv.networks import convert_checkpoint


def convert(
    source: Annotated[Path, typer.Argument(help="A PointNet++ classifier saved by PyTorch, .pth or .pt.")],
    target: Annotated[Path, typer.Argument(help="The .safetensors file to write.")],
) -> None:
    """Rewrite a PyTorch checkpoint as safetensors. Nothing in it is run, and PyTorch is not needed."""
    network = convert_checkpoint(source, target)
    typer.echo(f"{target}   PointNet++ for {network.num_classes} classes")
