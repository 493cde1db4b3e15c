"""The names and shapes of the tensors of the widely used PyTorch PointNet++, and the networks that they make.

    sa1, sa2     mlp_convs.<layer>, mlp_bns.<layer>              one radius
                 conv_blocks.<radius>.<layer>, bn_blocks. ...    several radii
    sa3          mlp_convs.<layer>, mlp_bns.<layer>              all points
    fc1, bn1, fc2, bn2, fc3                                      the classifier's perceptron
    fp3, fp2, fp1    mlp_convs.<layer>, mlp_bns.<layer>          the part segmenter's way back
    conv1, bn1, conv2                                            its perceptron

Channels, layers, classes, parts and the use of normals are read off the shapes; the radii are those published for one
radius or for several. Weights are kept in inference form, W' = W g / sqrt(v + eps), b' = (b - m) g / sqrt(v + eps) + h,
with the batch normalisation's scale g, shift h and running mean m and variance v.
"""

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np

from jaxnbv.checks import require
from jaxnbv.networks.layers import FeaturePropagation, Linear, PooledMLP, SetAbstraction
from jaxnbv.networks.pointnet2 import PARTS_SCALES, SCALES, Level, PointNet2Classifier, PointNet2PartSegmenter

Tensors = Mapping[str, np.ndarray]

_EPSILON = 1e-5
_ENCODER = {"sa1", "sa2", "sa3"}
_CLASSIFIER = _ENCODER | {"fc1", "bn1", "fc2", "bn2", "fc3"}
_SEGMENTER = _ENCODER | {"fp3", "fp2", "fp1", "conv1", "bn1", "conv2"}


def is_segmenter(tensors: Tensors) -> bool:
    """Whether the names are those of a network that carries features back to the points."""
    return any(name.startswith("fp") for name in tensors)


def build_classifier(tensors: Tensors) -> PointNet2Classifier:
    """The classifier that the tensors make.

    **Raises:** `ValueError` that names the tensor which is missing, not of its shape, not finite or without a place.
    """
    state = _State(tensors)
    state.check_parts(_CLASSIFIER)
    levels, widths = _levels(state, SCALES, {3: "points", 6: "with normals"})
    whole = state.pooled("sa3.mlp_convs", 3 + widths[-1])
    hidden = []
    width = _width(whole.layers)
    for number in (1, 2):
        hidden.append(_linear(*state.linear(f"fc{number}", width, f"bn{number}")))
        width = _width(hidden)
    last = _linear(*state.linear("fc3", width))
    state.check_all_taken()
    return PointNet2Classifier(levels, whole, tuple(hidden), last)


def build_part_segmenter(tensors: Tensors) -> PointNet2PartSegmenter:
    """The part segmenter that the tensors make.

    **Raises:** `ValueError` as `build_classifier` does.
    """
    state = _State(tensors)
    state.check_parts(_SEGMENTER)
    levels, widths = _levels(state, PARTS_SCALES, {6: "points", 9: "with normals"})
    whole = state.pooled("sa3.mlp_convs", 3 + widths[-1])
    # The first propagation's own inputs: one for each category, the coordinates, and the first level's features.
    name = "fp1.mlp_convs.0.weight"
    inputs = state.take(name, None, None).shape[1]
    propagations = []
    width = _width(whole.layers)
    for number, own in ((3, widths[2]), (2, widths[1]), (1, None)):
        least = width + 3 + widths[0] + 1
        require(
            own is not None or inputs >= least, f"the tensor {name} takes {inputs} inputs; expected {least} or more"
        )
        layers = state.layers(f"fp{number}.mlp_convs", inputs if own is None else own + width)
        propagations.append(FeaturePropagation(layers))
        width = _width(layers)
    hidden = _linear(*state.linear("conv1", width, "bn1"))
    last = _linear(*state.linear("conv2", _width([hidden])))
    state.check_all_taken()
    return PointNet2PartSegmenter(levels, whole, tuple(propagations), hidden, last)


def tensors_of(network: PointNet2Classifier | PointNet2PartSegmenter) -> dict[str, np.ndarray]:
    """A network's weights in the names above, with batch normalisations that do nothing.

    **Raises:** `ValueError` for a network whose sampling or depth is not the published one.
    """
    if isinstance(network, PointNet2PartSegmenter):
        scales, as_deep = PARTS_SCALES, len(network.propagations) == 3
    else:
        scales, as_deep = SCALES, len(network.hidden) == 2
    multi = len(network.levels[0].radii) > 1
    expected = scales[multi]
    sampling = tuple((level.centers, level.radii, level.members) for level in network.levels)
    require(
        sampling == expected and as_deep,
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

    def put_layers(layers: tuple[Linear, ...], name: str, kernel=(1, 1), coordinates_last=False) -> None:
        for index, layer in enumerate(layers):
            put(layer, f"{name}.{index}", f"{_norm(name)}.{index}", kernel, roll=coordinates_last and index == 0)

    for number, level in enumerate(network.levels, start=1):
        for branch, name in zip(level.branches, _branch_names(f"sa{number}", len(level.radii)), strict=True):
            put_layers(branch.layers, name, coordinates_last=multi)
    put_layers(network.whole.layers, "sa3.mlp_convs")
    if isinstance(network, PointNet2PartSegmenter):
        for number, propagation in zip((3, 2, 1), network.propagations, strict=True):
            put_layers(propagation.layers, f"fp{number}.mlp_convs", (1,))
        put(network.hidden, "conv1", "bn1", (1,))
        put(network.last, "conv2", None, (1,))
    else:
        for number, layer in enumerate(network.hidden, start=1):
            put(layer, f"fc{number}", f"bn{number}", ())
        put(network.last, "fc3", None, ())
    return tensors


class _State:
    """Tensors by name, each with its shape checked, as float64; what has not been taken in the end has no place."""

    def __init__(self, tensors: Tensors):
        self.tensors = {name: array for name, array in tensors.items() if not name.endswith("num_batches_tracked")}
        self.left = set(self.tensors)

    def check_parts(self, parts: set[str]) -> None:
        foreign = {name.split(".")[0] for name in self.tensors} - parts
        require(not foreign, f"{sorted(foreign)} belong to another kind of network")

    def check_all_taken(self) -> None:
        require(not self.left, f"{len(self.left)} tensors have no place in it, such as {sorted(self.left)[:1]}")

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

    def layers(self, name: str, inputs: int, coordinates_last: bool = False) -> tuple[Linear, ...]:
        """The layers <name>.0, <name>.1, ...; the coordinates among the first one's inputs are put first."""
        layers: list[Linear] = []
        while not layers or f"{name}.{len(layers)}.weight" in self.tensors:
            weight, bias = self.linear(f"{name}.{len(layers)}", inputs, f"{_norm(name)}.{len(layers)}")
            if coordinates_last and not layers:
                weight = np.roll(weight, 3, axis=0)
            layers.append(_linear(weight, bias))
            inputs = len(bias)
        return tuple(layers)

    def pooled(self, name: str, inputs: int, coordinates_last: bool = False) -> PooledMLP:
        """The same layers, as a PointNet."""
        layers = self.layers(name, inputs, coordinates_last)
        require(len(layers) > 1, f"{name} has one layer only; two or more are needed")
        return PooledMLP(layers)


def _levels(
    state: _State, scales: tuple[tuple[Level, ...], tuple[Level, ...]], known: dict[int, str]
) -> tuple[tuple[SetAbstraction, ...], list[int]]:
    """The set abstractions, and the numbers of features: of the points, then of each level's centres."""
    multi = "sa1.conv_blocks.0.0.weight" in state.tensors
    first = "sa1.conv_blocks.0.0.weight" if multi else "sa1.mlp_convs.0.weight"
    inputs = state.take(first, None, None).shape[1]
    choices = " or ".join(f"{number} ({what})" for number, what in known.items())
    require(inputs in known, f"the tensor {first} takes {inputs} inputs; expected {choices}")
    levels, widths = [], [inputs - 3]
    for number, level in enumerate(scales[multi], start=1):
        names = _branch_names(f"sa{number}", len(level.radii))
        branches = tuple(state.pooled(name, 3 + widths[-1], coordinates_last=multi) for name in names)
        levels.append(SetAbstraction(branches, level.radii, level.members, level.centers))
        widths.append(sum(_width(branch.layers) for branch in branches))
    return tuple(levels), widths


def _branch_names(level: str, radii: int) -> list[str]:
    return [f"{level}.mlp_convs"] if radii == 1 else [f"{level}.conv_blocks.{branch}" for branch in range(radii)]


def _norm(name: str) -> str:
    """The batch normalisations after the layers of a name."""
    return name.replace("mlp_convs", "mlp_bns").replace("conv_blocks", "bn_blocks")


def _linear(weight: np.ndarray, bias: np.ndarray) -> Linear:
    dtype = jnp.result_type(float)
    with np.errstate(over="ignore"):
        arrays = [array.astype(dtype) for array in (weight, bias)]
    finite = all(np.isfinite(array).all() for array in arrays)
    require(finite, f"a layer of shape {weight.shape} has entries that are not finite as {dtype}: train it again")
    return Linear(*map(jnp.asarray, arrays))


def _width(layers: tuple[Linear, ...] | list[Linear]) -> int:
    return layers[-1].bias.shape[0]
