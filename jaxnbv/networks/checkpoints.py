"""Networks from files and back: published PointNet++ checkpoints, safetensors, and the files of our own networks."""

import os
from collections.abc import Mapping
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import safetensors.numpy
from safetensors import SafetensorError

from jaxnbv.checks import InputError, require
from jaxnbv.networks.native import NativeNetwork, arrays_of, build_native, is_native
from jaxnbv.networks.pointnet2 import PointNet2Classifier, PointNet2PartSegmenter
from jaxnbv.networks.state_dict import build_classifier, build_part_segmenter, is_segmenter, tensors_of
from jaxnbv.networks.torch_format import read_torch_tensors
from jaxnbv.storage.files import write_whole

Network = PointNet2Classifier | PointNet2PartSegmenter | NativeNetwork
_Tensors = Mapping[str, np.ndarray]
_SAFETENSORS_TYPES = {"F64", "F32", "F16", "I64", "I32", "I16", "I8", "U64", "U32", "U16", "U8", "BOOL"}


def load_checkpoint(path: str | Path) -> Network:
    """The network in a PyTorch (.pth, .pt) or .safetensors file, recognised by the names of its tensors.

    That is a classifier or a part segmenter: PointNet++ as published, or one of our own that `save_checkpoint` wrote.
    Nothing in the file is run, and PyTorch is not needed. `CloudClassifier` and `CloudSegmenter` feed it clouds.

    **Raises:** `ValueError` for another suffix, a file that is missing or damaged, and for tensors that make none of
    these networks.
    """
    return _network(path, *_read(path))


def save_checkpoint(network: Network | _Tensors, path: str | Path) -> None:
    """Write a network, or tensors in the published names, as a safetensors file; PyTorch can load either.

    **Raises:** `ValueError` for a PointNet++ whose sampling is not the published one, which the file could not tell,
    and for a place that cannot be written.
    """
    metadata: dict[str, str] = {}
    if isinstance(network, NativeNetwork):
        tensors, metadata = arrays_of(network)
    else:
        tensors = dict(network if isinstance(network, Mapping) else tensors_of(network))
    # bfloat16 is unknown to NumPy and so to most readers of safetensors; float32 holds it exactly.
    arrays = {
        name: np.array(tensor, np.float32 if tensor.dtype == jnp.bfloat16 else tensor.dtype, order="C")
        for name, tensor in tensors.items()
    }
    write_whole(Path(path), lambda file: file.write(safetensors.numpy.save(arrays, metadata)))


def convert_checkpoint(source: str | Path, target: str | Path) -> Network:
    """Rewrite the model's tensors of any checkpoint, unchanged, as a safetensors file; returns the network.

    **Raises:** `ValueError` as `load_checkpoint` does, or if the target does not end in .safetensors.
    """
    require(Path(target).suffix == ".safetensors", f"the target {target} must end in .safetensors")
    tensors, metadata = _read(source)
    network = _network(source, tensors, metadata)
    save_checkpoint(network if isinstance(network, NativeNetwork) else tensors, target)
    return network


def _read(path: str | Path) -> tuple[_Tensors, Mapping[str, str]]:
    """Tensors by name, and metadata."""
    suffix = Path(path).suffix
    require(
        suffix in (".pth", ".pt", ".safetensors"),
        f"cannot tell what {path} is: a checkpoint ends in .pth or .pt (PyTorch) or .safetensors",
    )
    if suffix != ".safetensors":
        return read_torch_tensors(path), {}
    require(os.path.isfile(path), f"there is no file {path}: give the path of a safetensors file")
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            types = {name: file.get_slice(name).get_dtype() for name in file.keys()}  # noqa: SIM118
            for name, kind in types.items():
                known = kind in _SAFETENSORS_TYPES
                require(known, f"{path}: the array {name} is of type {kind}, which NumPy has not; write it as float32")
            return {name: file.get_tensor(name) for name in types}, file.metadata() or {}
    except InputError:
        raise
    except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is damaged or no safetensors file ({error}): fetch or write it again") from error


def _network(path: str | Path, tensors: _Tensors, metadata: Mapping[str, str]) -> Network:
    try:
        if is_native(tensors):
            return build_native(tensors, metadata)
        return build_part_segmenter(tensors) if is_segmenter(tensors) else build_classifier(tensors)
    except InputError as error:
        raise InputError(f"{path} does not hold a network that is known here: {error}") from error
