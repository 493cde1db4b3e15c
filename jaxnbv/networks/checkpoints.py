"""PointNet++ classifiers from checkpoints in the names of the widely used PyTorch code, and back to safetensors.

    sa1, sa2     mlp_convs.<layer>, mlp_bns.<layer>              one radius
                 conv_blocks.<radius>.<layer>, bn_blocks. ...    several radii
    sa3          mlp_convs.<layer>, mlp_bns.<layer>              all points
    fc1, bn1, fc2, bn2, fc3                                      the perceptron

Channels, layers, classes and the use of normals are read off the shapes; the radii are those published for one radius
or for three. Weights are kept in inference form, W' = W g / sqrt(v + eps), b' = (b - m) g / sqrt(v + eps) + h, with the
batch normalisation's scale g, shift h and running mean m and variance v.
"""

from collections.abc import Mapping
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import safetensors.numpy
from safetensors import SafetensorError

from jaxnbv.checks import InputError, require
from jaxnbv.networks.pointnet2 import MULTI_SCALE, SINGLE_SCALE, PointNet2Classifier
from jaxnbv.networks.set_abstraction import Linear, PooledMLP, SetAbstraction
from jaxnbv.networks.torch_format import read_torch_tensors

_EPSILON = 1e-5
_PARTS = {"sa1", "sa2", "sa3", "fc1", "bn1", "fc2", "bn2", "fc3"}
_READERS = "a checkpoint ends in .pth or .pt (PyTorch) or .safetensors"


def load_checkpoint(path: str | Path) -> PointNet2Classifier:
    """The classifier in a PyTorch (.pth, .pt) or .safetensors file.

    **Raises:** `ValueError` for another suffix, and as the two readers do.
    """
    return _classifier(path, _read_tensors(path))


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


def save_safetensors(network: PointNet2Classifier | Mapping[str, np.ndarray], path: str | Path) -> None:
    """Write a classifier, or tensors in the names above, as a safetensors file; PyTorch can load either.

    **Raises:** `ValueError` for a network whose sampling is not the published one, which the file could not tell, and
    for a place that cannot be written.
    """
    tensors = _tensors(network) if isinstance(network, PointNet2Classifier) else network
    # bfloat16 is unknown to NumPy and so to most readers of safetensors; float32 holds it exactly.
    arrays = {
        name: np.array(tensor, np.float32 if tensor.dtype == jnp.bfloat16 else tensor.dtype, order="C")
        for name, tensor in tensors.items()
    }
    path = Path(path)
    partial = path.with_name(path.name + ".partial")
    try:
        partial.write_bytes(safetensors.numpy.save(arrays))
        partial.replace(path)
    except OSError as error:
        raise InputError(f"cannot write {path} ({error}): choose another place") from error


def convert_checkpoint(source: str | Path, target: str | Path) -> PointNet2Classifier:
    """Rewrite the model's tensors of any checkpoint, unchanged, as a safetensors file; returns the classifier.

    **Raises:** `ValueError` if the source is not a classifier's checkpoint or the target does not end in .safetensors.
    """
    require(Path(target).suffix == ".safetensors", f"the target {target} must end in .safetensors")
    tensors = _read_tensors(source)
    network = _classifier(source, tensors)
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


class _State:
    """Tensors by name, each taken once, as float64 and with its shape checked."""

    def __init__(self, tensors: Mapping[str, np.ndarray]):
        self.tensors = {name: array for name, array in tensors.items() if not name.endswith("num_batches_tracked")}
        self.left = set(self.tensors)

    def take(self, name: str, *shape: int | None) -> np.ndarray:
        """The tensor, whose shape must be this; None stands for any length, and 1s may follow."""
        require(name in self.tensors, f"the tensor {name} is missing")
        found = self.tensors[name].shape
        fits = len(found) >= len(shape) and all(a in (None, b) for a, b in zip(shape, found, strict=False))
        require(
            fits and all(length == 1 for length in found[len(shape) :]),
            f"the tensor {name} has shape {found}; expected ({', '.join(str(a or 'any') for a in shape)})",
        )
        array = np.asarray(self.tensors[name], dtype=np.float64).reshape(found[: len(shape)])
        require(bool(np.isfinite(array).all()), f"the tensor {name} has entries that are not finite")
        self.left.discard(name)
        return array

    def linear(self, name: str, inputs: int | None, norm: str | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Weight (inputs, outputs) and bias of a layer, the batch normalisation after it included."""
        weight = self.take(f"{name}.weight", None, inputs).T
        outputs = weight.shape[1]
        bias = self.take(f"{name}.bias", outputs)
        if norm is None:
            return weight, bias
        variance = self.take(f"{norm}.running_var", outputs)
        require(bool((variance >= 0).all()), f"the tensor {norm}.running_var has negative entries")
        scale = self.take(f"{norm}.weight", outputs) / np.sqrt(variance + _EPSILON)
        shift = self.take(f"{norm}.bias", outputs) - self.take(f"{norm}.running_mean", outputs) * scale
        return weight * scale, bias * scale + shift

    def pooled(self, name: str, norm: str, inputs: int | None, coordinates_last: bool = False) -> PooledMLP:
        """The layers <name>.0, <name>.1, ...; the coordinates among the first one's inputs are put first."""
        layers: list[Linear] = []
        while not layers or f"{name}.{len(layers)}.weight" in self.tensors:
            weight, bias = self.linear(f"{name}.{len(layers)}", inputs, f"{norm}.{len(layers)}")
            if coordinates_last and not layers:
                weight = np.roll(weight, 3, axis=0)
            layers.append(_linear(weight, bias))
            inputs = len(bias)
        require(len(layers) > 1, f"{name} has one layer only; two or more are needed")
        return PooledMLP(tuple(layers))


def _linear(weight: np.ndarray, bias: np.ndarray) -> Linear:
    dtype = jnp.result_type(float)
    return Linear(jnp.asarray(weight, dtype=dtype), jnp.asarray(bias, dtype=dtype))


def _branch_names(level: str, radii: int) -> list[tuple[str, str]]:
    if radii == 1:
        return [(f"{level}.mlp_convs", f"{level}.mlp_bns")]
    return [(f"{level}.conv_blocks.{branch}", f"{level}.bn_blocks.{branch}") for branch in range(radii)]


def _classifier(path: str | Path, tensors: Mapping[str, np.ndarray]) -> PointNet2Classifier:
    try:
        return _build(_State(tensors))
    except InputError as error:
        raise InputError(f"{path} does not hold a PointNet++ classifier: {error}") from error


def _build(state: _State) -> PointNet2Classifier:
    foreign = {name.split(".")[0] for name in state.tensors} - _PARTS
    require(not foreign, f"{sorted(foreign)} belong to another kind of network, such as one for segmentation")
    multi = "sa1.conv_blocks.0.0.weight" in state.tensors
    first = "sa1.conv_blocks.0.0.weight" if multi else "sa1.mlp_convs.0.weight"
    inputs = state.take(first, None, None).shape[1]
    require(inputs in (3, 6), f"the tensor {first} takes {inputs} inputs; expected 3 (points) or 6 (with normals)")
    levels = []
    for number, level in enumerate(MULTI_SCALE if multi else SINGLE_SCALE, start=1):
        names = _branch_names(f"sa{number}", len(level.radii))
        branches = tuple(state.pooled(name, norm, inputs, coordinates_last=multi) for name, norm in names)
        levels.append(SetAbstraction(branches, level.radii, level.members, level.centers))
        inputs = 3 + sum(branch.layers[-1].bias.shape[0] for branch in branches)
    whole = state.pooled("sa3.mlp_convs", "sa3.mlp_bns", inputs)
    hidden = []
    width = whole.layers[-1].bias.shape[0]
    for number in (1, 2):
        hidden.append(_linear(*state.linear(f"fc{number}", width, f"bn{number}")))
        width = hidden[-1].bias.shape[0]
    last = _linear(*state.linear("fc3", width))
    require(not state.left, f"{len(state.left)} tensors have no place in it, such as {sorted(state.left)[:1]}")
    return PointNet2Classifier(tuple(levels), whole, tuple(hidden), last)


def _tensors(network: PointNet2Classifier) -> dict[str, np.ndarray]:
    """A network's weights in the names above, with batch normalisations that do nothing."""
    multi = len(network.levels[0].radii) > 1
    expected = MULTI_SCALE if multi else SINGLE_SCALE
    sampling = tuple((level.centers, level.radii, level.members) for level in network.levels)
    require(
        sampling == expected and len(network.hidden) == 2,
        f"the file cannot tell a network that samples with {sampling}; only the published {expected} can be saved",
    )
    tensors: dict[str, np.ndarray] = {}

    def put(layer: Linear, name: str, norm: str | None, kernel: tuple[int, ...], roll: bool = False) -> None:
        weight, bias = np.asarray(layer.weight), np.asarray(layer.bias)
        weight = np.roll(weight, -3, axis=0) if roll else weight
        tensors[f"{name}.weight"], tensors[f"{name}.bias"] = weight.T.reshape(*weight.T.shape, *kernel), bias
        if norm is not None:
            ones = np.ones_like(bias)
            tensors[f"{norm}.weight"], tensors[f"{norm}.running_var"] = ones, ones - np.asarray(_EPSILON, bias.dtype)
            tensors[f"{norm}.bias"], tensors[f"{norm}.running_mean"] = 0 * ones, 0 * ones

    def put_pooled(mlp: PooledMLP, name: str, norm: str, coordinates_last: bool = False) -> None:
        for index, layer in enumerate(mlp.layers):
            put(layer, f"{name}.{index}", f"{norm}.{index}", (1, 1), roll=coordinates_last and index == 0)

    for number, level in enumerate(network.levels, start=1):
        for branch, names in zip(level.branches, _branch_names(f"sa{number}", len(level.radii)), strict=True):
            put_pooled(branch, *names, coordinates_last=multi)
    put_pooled(network.whole, "sa3.mlp_convs", "sa3.mlp_bns")
    for number, layer in enumerate(network.hidden, start=1):
        put(layer, f"fc{number}", f"bn{number}", ())
    put(network.last, "fc3", None, ())
    return tensors
