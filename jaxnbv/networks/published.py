"""Makes networks from tensors of the widely used PyTorch code of PointNet++. The tensors' names are:

    sa1, sa2     mlp_convs.<layer>, mlp_bns.<layer>              one radius
                 conv_blocks.<radius>.<layer>, bn_blocks. ...    several radii
    sa3          mlp_convs.<layer>, mlp_bns.<layer>              all points
    fc1, bn1, fc2, bn2, fc3                                      the classifier's perceptron
    fp3, fp2, fp1    mlp_convs.<layer>, mlp_bns.<layer>          the part segmenter's feature propagations
    conv1, bn1, conv2                                            the part segmenter's perceptron

The shapes of the tensors give the numbers of channels, layers, classes and parts, and say whether normals are used. The
radii are not stored, so they are those of the published networks with one or with several radii per level. Batch
normalisation is merged into the weights W and the bias b of a layer: W' = W g / sqrt(v + eps) and
b' = (b - m) g / sqrt(v + eps) + h, with the scale g, the shift h, the running mean m and the running variance v of the
normalisation, and eps = 1e-5.
"""

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np

from jaxnbv.checks import require
from jaxnbv.networks.layers import FeaturePropagation, Linear, PooledMLP, SetAbstraction
from jaxnbv.networks.pointnet2 import PARTS_SCALES, SCALES, Level, PointNet2Classifier, PointNet2PartSegmenter

Tensors = Mapping[str, np.ndarray]

_EPSILON = 1e-5


def published_network(tensors: Tensors) -> PointNet2Classifier | PointNet2PartSegmenter:
    """Make the network that has these tensors.

    It is a part segmenter if the tensors include feature-propagation layers ("fp..."), else a classifier.

    **Raises:** `ValueError` if a tensor is missing, unexpected, of a wrong shape or not finite.
    """
    state = _State(tensors)
    segments = any(name.startswith("fp") for name in tensors)
    network = _part_segmenter(state) if segments else _classifier(state)
    require(
        not state.unused,
        f"{len(state.unused)} tensors are not part of such a network, such as {sorted(state.unused)[:1]}",
    )
    return network


def _classifier(state: "_State") -> PointNet2Classifier:
    levels, whole, _ = _encoder(state, SCALES, {3: "points", 6: "with normals"})
    first = state.linear("fc1", _width(whole.layers[-1]), "bn1")
    second = state.linear("fc2", _width(first), "bn2")
    return PointNet2Classifier(levels, whole, (first, second), state.linear("fc3", _width(second)))


def _part_segmenter(state: "_State") -> PointNet2PartSegmenter:
    levels, whole, widths = _encoder(state, PARTS_SCALES, {6: "points", 9: "with normals"})
    width = _width(whole.layers[-1])
    propagations = []
    # The last propagation takes, beside the interpolated features, the category, coordinates and features of the point.
    for number, own in ((3, widths[2]), (2, widths[1]), (1, None)):
        layers = state.layers(f"fp{number}.mlp_convs", None if own is None else own + width)
        propagations.append(FeaturePropagation(layers))
        width = _width(layers[-1])
    hidden = state.linear("conv1", width, "bn1")
    last = state.linear("conv2", _width(hidden))
    network = PointNet2PartSegmenter(levels, whole, tuple(propagations), hidden, last)
    require(network.num_categories > 0, "the tensor fp1.mlp_convs.0.weight has no inputs for categories")
    return network


def _encoder(
    state: "_State", scales: tuple[tuple[Level, ...], tuple[Level, ...]], kinds: dict[int, str]
) -> tuple[tuple[SetAbstraction, ...], PooledMLP, list[int]]:
    """Return the set abstractions, the PointNet over the last centres, and the numbers of features.

    The first number of features is that of an input point, without coordinates. The others are those of each level.

    - `scales`: sizes of the levels for a network with one radius per level, and for a network with several.
    - `kinds`: allowed numbers of inputs of the first layer, each with its meaning.
    """
    is_multi_scale = "sa1.conv_blocks.0.0.weight" in state.tensors
    first = "sa1.conv_blocks.0.0.weight" if is_multi_scale else "sa1.mlp_convs.0.weight"
    inputs = state.take(first, None, None).shape[1]
    choices = " or ".join(f"{number} ({meaning})" for number, meaning in kinds.items())
    require(inputs in kinds, f"the tensor {first} takes {inputs} inputs; expected {choices}")
    levels, widths = [], [inputs - 3]
    for number, level in enumerate(scales[is_multi_scale], start=1):
        blocks = [f"conv_blocks.{index}" for index in range(len(level.radii))] if is_multi_scale else ["mlp_convs"]
        branches = tuple(state.pooled(f"sa{number}.{block}", 3 + widths[-1], roll=is_multi_scale) for block in blocks)
        levels.append(SetAbstraction(branches, level.radii, level.members, level.centers))
        widths.append(sum(_width(branch.layers[-1]) for branch in branches))
    return tuple(levels), state.pooled("sa3.mlp_convs", 3 + widths[-1]), widths


class _State:
    """Tensors keyed by name, with checks of their shapes, and the names of the tensors not used so far."""

    def __init__(self, tensors: Tensors):
        self.tensors = {name: array for name, array in tensors.items() if not name.endswith("num_batches_tracked")}
        self.unused = set(self.tensors)

    def take(self, name: str, *shape: int | None) -> np.ndarray:
        """Check the shape of a tensor, and return the tensor as float64.

        - `shape`: required shape, where None is any length. Further axes of length 1 are removed.
        """
        require(name in self.tensors, f"the tensor {name} is missing")
        actual = self.tensors[name].shape
        fits = len(actual) >= len(shape) and all(a in (None, b) for a, b in zip(shape, actual, strict=False))
        require(
            fits and all(length == 1 for length in actual[len(shape) :]),
            f"the tensor {name} has shape {actual}; expected ({', '.join(str(a or 'any') for a in shape)})",
        )
        self.unused.discard(name)
        return np.asarray(self.tensors[name], dtype=np.float64).reshape(actual[: len(shape)])

    def linear(self, name: str, inputs: int | None, norm: str | None = None, roll: bool = False) -> Linear:
        """Make the layer `name`, and merge the batch normalisation `norm` that follows it, if any.

        - `inputs`: required number of inputs; None for any number.
        - `roll`: whether the file has the coordinates as the last three inputs. They become the first three.
        """
        weight = self.take(f"{name}.weight", None, inputs).T
        outputs = weight.shape[1]
        bias = self.take(f"{name}.bias", outputs)
        if norm is not None:
            variance = self.take(f"{norm}.running_var", outputs)
            require(bool((variance >= 0).all()), f"the tensor {norm}.running_var has negative entries")
            scale = self.take(f"{norm}.weight", outputs) / np.sqrt(variance + _EPSILON)
            shift = self.take(f"{norm}.bias", outputs) - self.take(f"{norm}.running_mean", outputs) * scale
            weight, bias = weight * scale, bias * scale + shift
        weight = np.roll(weight, 3, axis=0) if roll else weight
        with np.errstate(over="ignore"):
            arrays = [array.astype(jnp.result_type(float)) for array in (weight, bias)]
        is_finite = all(np.isfinite(array).all() for array in arrays)
        require(is_finite, f"the layer {name} has entries that are not finite as {arrays[0].dtype}: train it again")
        return Linear(*map(jnp.asarray, arrays))

    def layers(self, name: str, inputs: int | None, roll: bool = False) -> tuple[Linear, ...]:
        """Make the layers <name>.0, <name>.1, ..., each merged with its batch normalisation.

        `inputs` and `roll` are those of the first layer, see `linear`.
        """
        norm = name.replace("mlp_convs", "mlp_bns").replace("conv_blocks", "bn_blocks")
        layers: list[Linear] = []
        while not layers or f"{name}.{len(layers)}.weight" in self.tensors:
            number = len(layers)
            layers.append(self.linear(f"{name}.{number}", inputs, f"{norm}.{number}", roll and number == 0))
            inputs = _width(layers[-1])
        return tuple(layers)

    def pooled(self, name: str, inputs: int, roll: bool = False) -> PooledMLP:
        layers = self.layers(name, inputs, roll)
        require(len(layers) > 1, f"{name} has one layer only; two or more are needed")
        return PooledMLP(layers)


def _width(layer: Linear) -> int:
    return layer.bias.shape[0]
