"""What `jaxnbv convert` does."""

from pathlib import Path

import typer

from jaxnbv.networks import PointNet2Classifier, convert_checkpoint


def convert(source: Path, target: Path) -> None:
    """Rewrite a PyTorch checkpoint as safetensors."""
    network = convert_checkpoint(source, target)
    if isinstance(network, PointNet2Classifier):
        what = f"{network.num_classes} classes"
    else:
        what = f"{network.num_parts} parts of {network.num_categories} categories"
    typer.echo(f"{target}   PointNet++ for {what}")
