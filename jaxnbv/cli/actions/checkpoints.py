"""What `jaxnbv convert` does."""

from pathlib import Path

import typer

from jaxnbv.networks import PointNet2Classifier, PointNet2PartSegmenter, convert_checkpoint


def convert(source: Path, target: Path) -> None:
    """Rewrite a PyTorch checkpoint as safetensors."""
    network = convert_checkpoint(source, target)
    if isinstance(network, PointNet2Classifier):
        what = f"PointNet++ for {network.num_classes} classes"
    elif isinstance(network, PointNet2PartSegmenter):
        what = f"PointNet++ for {network.num_parts} parts of {network.num_categories} categories"
    else:
        what = type(network).__name__
    typer.echo(f"{target}   {what}")
