"""`jaxnbv convert`: checkpoints."""

from pathlib import Path
from typing import Annotated

import typer

from jaxnbv.networks import PointNet2Classifier, convert_checkpoint


def convert(
    source: Annotated[Path, typer.Argument(help="A PointNet++ network saved by PyTorch, .pth or .pt.")],
    target: Annotated[Path, typer.Argument(help="The .safetensors file to write.")],
) -> None:
    """Rewrite a PyTorch checkpoint as safetensors. Nothing in it is run, and PyTorch is not needed."""
    network = convert_checkpoint(source, target)
    if isinstance(network, PointNet2Classifier):
        what = f"{network.num_classes} classes"
    else:
        what = f"{network.num_parts} parts of {network.num_categories} categories"
    typer.echo(f"{target}   PointNet++ for {what}")
