"""Networks from checkpoints are read or refused."""

import json
from importlib import resources

import equinox as eqx
import jax
import numpy as np
import pytest
import safetensors.numpy
from published_networks import classifier_state
from torch_files import checkpoint

import jaxnbv as nbv
from jaxnbv.networks import CloudClassifier, CompactPartSegmenter, InvariantClassifier, load_checkpoint, save_checkpoint
from jaxnbv.networks.pretrained import pretrained_classifier
from jaxnbv.networks.torch_format import read_torch_tensors
from jaxnbv.studies.scenes import PATTERNS

RNG = np.random.default_rng(0)


@pytest.fixture
def state():
    return classifier_state(RNG, "ssg", 6)


def test_shipped_weights_are_small_and_name_their_classes():
    for file in (resources.files("jaxnbv.networks") / "weights").iterdir():
        assert len(file.read_bytes()) < 2**20, file
    assert pretrained_classifier("pyramid").classes == PATTERNS


def assert_same(network, expected, rtol=1e-6):
    assert jax.tree.structure(network) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(network), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol)


@pytest.mark.parametrize("prefix", ["", "module."])
def test_a_network_is_the_same_from_safetensors_and_from_pytorch(tmp_path, state, prefix):
    safetensors.numpy.save_file(state, tmp_path / "net.safetensors")
    network = load_checkpoint(tmp_path / "net.safetensors")
    file = checkpoint(tmp_path / "net.pth", {f"{prefix}{name}": array for name, array in state.items()})
    assert set(read_torch_tensors(file)) == set(state)
    assert_same(load_checkpoint(file), network)
    with pytest.raises(nbv.InputError, match="network is a PointNet2Classifier"):
        save_checkpoint(network, tmp_path / "again.safetensors")


def test_tensors_that_make_no_classifier_are_named(tmp_path, state):
    def problem(changes, without=()):
        arrays = {name: array for name, array in {**state, **changes}.items() if name not in without}
        with pytest.raises(nbv.InputError, match=r"net\.pth does not hold") as error:
            load_checkpoint(checkpoint(tmp_path / "net.pth", arrays))
        return str(error.value)

    ones = np.ones((4, 9), np.float32)
    assert "sa2.mlp_bns.1.running_var is missing" in problem({}, ["sa2.mlp_bns.1.running_var"])
    assert "sa1.mlp_convs.0.weight is missing" in problem({}, ["sa1.mlp_convs.0.weight"])
    assert "fc3.weight has shape (4, 9); expected (any, 7)" in problem({"fc3.weight": ones})
    assert "takes 9 inputs" in problem({"sa1.mlp_convs.0.weight": ones})
    assert "sa3.mlp_bns.0.bias has shape (4, 9)" in problem({"sa3.mlp_bns.0.bias": ones})
    assert "negative" in problem({"bn1.running_var": -state["bn1.running_var"]})
    assert "not finite" in problem({"bn1.bias": np.full_like(state["bn1.bias"], np.nan)})
    assert "not part of such a network, such as ['fc1.extra']" in problem({"fc1.extra": ones})


def test_safetensors_files_that_are_damaged_or_missing(tmp_path, state):
    file = tmp_path / "state.safetensors"
    safetensors.numpy.save_file(state, file)
    whole = file.read_bytes()
    for damaged in (b"", b"abc", whole[:50], whole[:-3]):
        file.write_bytes(damaged)
        with pytest.raises(nbv.InputError, match=r"state\.safetensors is damaged"):
            load_checkpoint(file)
    with pytest.raises(nbv.InputError, match="no file"):
        load_checkpoint(tmp_path / "nowhere.safetensors")
    with pytest.raises(nbv.InputError, match="cannot write"):
        save_checkpoint(CompactPartSegmenter(jax.random.key(0)), tmp_path / "nowhere" / "net.safetensors")
    with pytest.raises(nbv.InputError, match=r"\.pth or \.pt"):
        load_checkpoint(tmp_path / "net.onnx")


OWN = {
    "named": lambda key: InvariantClassifier(3, key, classes=("cup", "wide plate", "bowl")),
    "focused": lambda key: InvariantClassifier(4, key, (0.3, 0.9), groups=(30, 10), focused=True),
    "parts": CompactPartSegmenter,
}


@pytest.fixture(scope="module", params=OWN)
def own(request):
    return eqx.filter_jit(OWN[request.param])(jax.random.key(4))


def test_networks_of_our_own_come_back(own, tmp_path):
    save_checkpoint(own, tmp_path / "net.safetensors")
    loaded = load_checkpoint(tmp_path / "net.safetensors")
    assert_same(loaded, own, rtol=0)
    if isinstance(own, InvariantClassifier):
        assert CloudClassifier(loaded).classes == own.classes


def test_files_that_hold_no_whole_network_of_our_own_are_refused(own, tmp_path):
    file = tmp_path / "net.safetensors"
    save_checkpoint(own, file)
    whole = safetensors.numpy.load_file(file)
    with safetensors.safe_open(file, "numpy") as opened:
        said = opened.metadata()["network"]
    name = next(name for name in whole if whole[name].ndim == 2)

    def problem(changes, without=(), said=said):
        arrays = {key: array for key, array in {**whole, **changes}.items() if key not in without}
        safetensors.numpy.save_file(arrays, file, {"network": said})
        with pytest.raises(nbv.InputError, match=r"net\.safetensors does not hold") as error:
            load_checkpoint(file)
        return str(error.value)

    assert f"{name} has shape" in problem({name: np.ascontiguousarray(whole[name][:, :-1])})
    assert f"{name} is missing" in problem({}, [name])
    assert "more is not part of" in problem({"more": np.zeros(3, np.float32)})
    assert f"{name} has entries that are not finite" in problem({name: np.full_like(whole[name], np.inf)})
    for nonsense in ("", "[]", "{}", '{"kind": "Perceptron"}', said.replace('"kind"', '"more": 1, "kind"')):
        assert "makes no network" in problem({}, said=nonsense)
    if own.__class__ is InvariantClassifier:
        assert "names 2 classes" in problem({}, said=json.dumps(json.loads(said) | {"classes": ["a", "b"]}))
