"""PointNet++ networks from published checkpoints, and back to safetensors; `state_dict` knows the tensors' names."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

import jax.numpy as jnp
import numpy as np
import safetensors.numpy
from safetensors import SafetensorError

from jaxnbv.checks import InputError, require
from jaxnbv.files import write_whole
from jaxnbv.networks.part_segmentation import PointNet2PartSegmenter
from jaxnbv.networks.pointnet2 import PointNet2Classifier
from jaxnbv.networks.state_dict import Tensors, build_classifier, build_part_segmenter, is_segmenter, tensors_of
from jaxnbv.networks.torch_format import read_torch_tensors

_Network = TypeVar("_Network")

_READERS = "a checkpoint ends in .pth or .pt (PyTorch) or .safetensors"


def load_checkpoint(path: str | Path) -> PointNet2Classifier:
    """The classifier in a PyTorch (.pth, .pt) or .safetensors file.

    **Raises:** `ValueError` for another suffix, and as the two readers do.
    """
    return _classifier(path, _read_tensors(path))


def load_part_segmenter(path: str | Path) -> PointNet2PartSegmenter:
    """The network that segments parts in a PyTorch (.pth, .pt) or .safetensors file.

    Nothing in the file is run, and PyTorch is not needed.

    **Raises:** `ValueError` for another suffix, a file that is missing or damaged, and for tensors that do not make a
    PointNet++ part segmenter.
    """
    return _part_segmenter(path, _read_tensors(path))


def load_torch_checkpoint(path: str | Path) -> PointNet2Classifier:
    """The classifier in a file made by `torch.save`; nothing in the file is run, and PyTorch is not needed.

    **Raises:** `ValueError` as `read_torch_tensors` does, and for tensors that do not make a PointNet++ classifier.
    """
    return _classifier(path, read_torch_tensors(path))


def load_safetensors(path: str | Path) -> PointNet2Classifier:
    """The classifier in a safetensors file.

    **Raises:** `ValueError` for a file that is missing or damaged, or whose tensors do not make a classifier.
    """
    return _classifier(path, _read_safetensors(path))


def save_safetensors(
    network: PointNet2Classifier | PointNet2PartSegmenter | Mapping[str, np.ndarray], path: str | Path
) -> None:
    """Write a network, or tensors in the published names, as a safetensors file; PyTorch can load either.

    **Raises:** `ValueError` for a network whose sampling is not the published one, which the file could not tell, and
    for a place that cannot be written.
    """
    tensors = network if isinstance(network, Mapping) else tensors_of(network)
    # bfloat16 is unknown to NumPy and so to most readers of safetensors; float32 holds it exactly.
    arrays = {
        name: np.array(tensor, np.float32 if tensor.dtype == jnp.bfloat16 else tensor.dtype, order="C")
        for name, tensor in tensors.items()
    }
    path = Path(path)
    try:
        write_whole(path, lambda file: file.write(safetensors.numpy.save(arrays)))
    except OSError as error:
        raise InputError(f"cannot write {path} ({error}): choose another place") from error


def convert_checkpoint(source: str | Path, target: str | Path) -> PointNet2Classifier | PointNet2PartSegmenter:
    """Rewrite the model's tensors of any checkpoint, unchanged, as a safetensors file; returns the network.

    **Raises:** `ValueError` if the source is the checkpoint of neither kind of network, or the target does not end in
    .safetensors.
    """
    require(Path(target).suffix == ".safetensors", f"the target {target} must end in .safetensors")
    tensors = _read_tensors(source)
    network = _part_segmenter(source, tensors) if is_segmenter(tensors) else _classifier(source, tensors)
    save_safetensors(tensors, target)
    return network


def _read_tensors(path: str | Path) -> dict[str, np.ndarray]:
    suffix = Path(path).suffix
    require(suffix in (".pth", ".pt", ".safetensors"), f"cannot tell what {path} is: {_READERS}")
    return _read_safetensors(path) if suffix == ".safetensors" else read_torch_tensors(path)


def _read_safetensors(path: str | Path) -> dict[str, np.ndarray]:
    require(Path(path).is_file(), f"there is no file {path}: give the path of a safetensors file")
    try:
        return safetensors.numpy.load_file(path)
    except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is damaged or no safetensors file ({error}): fetch or write it again") from error


def _classifier(path: str | Path, tensors: Tensors) -> PointNet2Classifier:
    return _build(build_classifier, tensors, f"{path} does not hold a PointNet++ classifier")


def _part_segmenter(path: str | Path, tensors: Tensors) -> PointNet2PartSegmenter:
    return _build(build_part_segmenter, tensors, f"{path} does not hold a PointNet++ part segmenter")


def _build(builder: Callable[[Tensors], _Network], tensors: Tensors, problem: str) -> _Network:
    try:
        return builder(tensors)
    except InputError as error:
        raise InputError(f"{problem}: {error}") from error
