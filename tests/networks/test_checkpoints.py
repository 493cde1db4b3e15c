"""Checkpoints written by hand, opcode by opcode: read, refused, converted."""

import itertools
import pickle
import struct
import zipfile

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy

from jaxnbv.checks import InputError
from jaxnbv.networks import (
    PointNet2Classifier,
    convert_checkpoint,
    load_checkpoint,
    load_safetensors,
    load_torch_checkpoint,
    read_torch_tensors,
    save_safetensors,
)
from jaxnbv.networks.pointnet2 import MULTI_SCALE, SINGLE_SCALE
from jaxnbv.networks.set_abstraction import Linear, PooledMLP, SetAbstraction

RNG = np.random.default_rng(0)
STORAGES = {
    "f8": "DoubleStorage",
    "f4": "FloatStorage",
    "f2": "HalfStorage",
    "i8": "LongStorage",
    "i4": "IntStorage",
    "u1": "ByteStorage",
    "b1": "BoolStorage",
}


class Op:
    """A piece of pickle program: its parts, and what is done with them."""

    def __init__(self, code, *parts):
        self.code, self.parts = code, parts


def call(name, *arguments):
    return Op(b"R", name, arguments)


def named(module, name):
    return Op(f"c{module}\n{name}\n".encode())


def program(thing):
    if isinstance(thing, Op):
        return b"".join(map(program, thing.parts)) + thing.code
    if isinstance(thing, tuple):
        return b"(" + b"".join(map(program, thing)) + b"t"
    if isinstance(thing, list):
        return b"](" + b"".join(map(program, thing)) + b"e"
    if isinstance(thing, dict):
        return b"}(" + b"".join(program(part) for item in thing.items() for part in item) + b"u"
    if isinstance(thing, str):
        return b"X" + struct.pack("<I", len(thing.encode())) + thing.encode()
    return pickle.dumps(thing, protocol=2)[2:-1]


def dumps(thing):
    return b"\x80\x02" + program(thing) + b"."


def storage(key, kind, count, *view):
    return Op(b"Q", ("storage", named("torch", kind), key, "cuda:0", count, *view))


def view(stored, offset, shape, strides):
    hooks = call(named("collections", "OrderedDict"))
    return call(named("torch._utils", "_rebuild_tensor_v2"), stored, offset, shape, strides, False, hooks)


def contiguous(shape):
    return tuple(int(np.prod(shape[i + 1 :])) for i in range(len(shape)))


def tensors_and_bytes(arrays, *view_metadata):
    """The pickle's tensors, and the bytes of their storages, big-endian where the array is."""
    tensors, data = {}, {}
    for index, (name, array) in enumerate(arrays.items()):
        kind = STORAGES[array.dtype.newbyteorder("<").str[1:]]
        stored = storage(str(index), kind, array.size, *view_metadata)
        tensors[name], data[str(index)] = view(stored, 0, array.shape, contiguous(array.shape)), array.tobytes()
    return tensors, data


def write_archive(path, content, data, order="little"):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("net/data.pkl", dumps(content))
        if order:
            archive.writestr("net/byteorder", order)
        for key, value in data.items():
            archive.writestr(f"net/data/{key}", value)
        archive.writestr("net/version", "3\n")
    return path


def write_stream(path, content, data, counts):
    head = [0x1950A86A20F9469CFC6C, 1001, {"protocol_version": 1001, "little_endian": True}]
    body = b"".join(struct.pack("<q", count) + data[key] for key, count in zip(data, counts, strict=True))
    path.write_bytes(b"".join(map(dumps, [*head, content, list(data)])) + body)
    return path


def checkpoint(path, arrays, **others):
    tensors, data = tensors_and_bytes(arrays)
    return write_archive(path, {"epoch": 3, **others, "model_state_dict": tensors}, data)


def layers(*widths):
    return tuple(
        Linear(jnp.asarray(RNG.normal(size=pair), jnp.float32), jnp.asarray(RNG.normal(size=pair[1]), jnp.float32))
        for pair in itertools.pairwise(widths)
    )


def narrow_network(sampling=SINGLE_SCALE, inputs=6):
    levels, width = [], inputs
    for level in sampling:
        branches = tuple(PooledMLP(layers(width, 4, 5 + branch)) for branch in range(len(level.radii)))
        levels.append(SetAbstraction(branches, level.radii, level.members, level.centers))
        width = 3 + sum(5 + branch for branch in range(len(level.radii)))
    return PointNet2Classifier(tuple(levels), PooledMLP(layers(width, 6, 8)), layers(8, 7, 6), layers(6, 4)[0])


def state_of(network, folder):
    save_safetensors(network, folder / "state.safetensors")
    return safetensors.numpy.load_file(folder / "state.safetensors")


@pytest.fixture
def state(tmp_path):
    return state_of(narrow_network(), tmp_path)


def assert_same(found, expected, rtol=1e-6):
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol)


@pytest.mark.parametrize("sampling", [SINGLE_SCALE, MULTI_SCALE])
@pytest.mark.parametrize("inputs", [3, 6])
def test_a_network_survives_safetensors_and_the_archive(tmp_path, sampling, inputs):
    network = narrow_network(sampling, inputs)
    arrays = state_of(network, tmp_path)
    assert_same(load_safetensors(tmp_path / "state.safetensors"), network)
    read = load_torch_checkpoint(checkpoint(tmp_path / "net.pth", arrays))
    assert_same(read, network)
    assert read.uses_normals == (inputs == 6)
    assert read.num_classes == 4
    assert [level.radii for level in read.levels] == [level.radii for level in sampling]


@pytest.mark.parametrize("order", ["little", "big", None])
def test_tensors_of_every_type_and_byte_order(tmp_path, order):
    arrays = {kind: RNG.uniform(0, 9, (2, 3, 4)).astype(kind) for kind in STORAGES}
    arrays["scalar"] = np.array(5, np.int64)
    stored = {name: array.astype(array.dtype.newbyteorder(">")) for name, array in arrays.items()}
    content, data = tensors_and_bytes(stored if order == "big" else arrays)
    found = read_torch_tensors(write_archive(tmp_path / "net.pth", content, data, order))
    for name, array in arrays.items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].dtype == array.dtype


def test_bfloat16(tmp_path):
    values = np.array([1.0, -2.5, 0.15625], np.float32)
    bits = (values.view(np.uint32) >> 16).astype(np.uint16)
    content = {"a": view(storage("0", "BFloat16Storage", 3), 0, (3,), (1,))}
    tensors = read_torch_tensors(write_archive(tmp_path / "net.pth", content, {"0": bits.tobytes()}))
    np.testing.assert_array_equal(tensors["a"].astype(np.float32), values)
    save_safetensors(tensors, tmp_path / "net.safetensors")
    np.testing.assert_array_equal(safetensors.numpy.load_file(tmp_path / "net.safetensors")["a"], values)


def test_views_of_one_storage(tmp_path):
    numbers = np.arange(24, dtype=np.float32)
    shared = storage("0", "FloatStorage", 24)
    parameter = named("torch._utils", "_rebuild_parameter")
    content = {
        "transposed": view(shared, 0, (6, 4), (1, 6)),
        "part": view(shared, 5, (2, 3), (8, 2)),
        "parameter": call(parameter, view(shared, 23, (1,), (1,)), True, {}),
        "none": view(shared, 0, (0, 3), (3, 1)),
    }
    found = read_torch_tensors(write_archive(tmp_path / "net.pth", content, {"0": numbers.tobytes()}))
    np.testing.assert_array_equal(found["transposed"], numbers.reshape(4, 6).T)
    np.testing.assert_array_equal(found["part"], 5 + np.array([[0, 2, 4], [8, 10, 12]]))
    np.testing.assert_array_equal(found["parameter"], [23])
    assert found["none"].shape == (0, 3)


@pytest.mark.parametrize("core", ["numpy.core.multiarray", "numpy._core.multiarray"])
def test_training_checkpoints_with_numpy_numbers_and_the_prefix_of_several_devices(tmp_path, state, core):
    text = call(named("_codecs", "encode"), struct.pack("<d", 0.875).decode("latin1"), "latin1")
    kind = Op(b"b", call(named("numpy", "dtype"), "f8", False, True), (3, "<", None, None, None, -1, -1, 0))
    accuracy = call(named(core, "scalar"), kind, text)
    file = checkpoint(tmp_path / "net.pth", {f"module.{k}": v for k, v in state.items()}, class_acc=accuracy)
    assert set(read_torch_tensors(file)) == set(state)
    assert_same(load_torch_checkpoint(file), load_safetensors(tmp_path / "state.safetensors"))


def test_the_older_layout(tmp_path, state):
    content, data = tensors_and_bytes(state, None)
    file = write_stream(tmp_path / "net.pth", content, data, [array.size for array in state.values()])
    for name, array in read_torch_tensors(file).items():
        np.testing.assert_array_equal(array, state[name])
    whole = file.read_bytes()
    for cut in (1, 5, 30, len(whole) // 2, len(whole) - 1):
        file.write_bytes(whole[:cut])
        with pytest.raises(InputError, match=r"net\.pth"):
            read_torch_tensors(file)


@pytest.mark.parametrize(
    ("module", "name"),
    [("os", "system"), ("posix", "system"), ("builtins", "eval"), ("builtins", "getattr"), ("torch", "load")],
)
@pytest.mark.parametrize("older", [False, True])
def test_a_file_that_asks_for_anything_else_is_refused_and_nothing_is_run(tmp_path, module, name, older):
    mark = tmp_path / "mark"
    attack = {"a": call(named(module, name), f"open({str(mark)!r}, 'w')" if name == "eval" else f"touch {mark}")}
    file = tmp_path / "net.pth"
    if older:
        write_stream(file, attack, {}, [])
    else:
        write_archive(file, attack, {})
    with pytest.raises(InputError, match=rf"net\.pth: refused: the file asks to run {module}\.{name}"):
        read_torch_tensors(file)
    file.write_bytes(dumps(attack))
    with pytest.raises(InputError, match="refused"):
        read_torch_tensors(file)
    assert not mark.exists()


def test_the_attack_would_have_worked(tmp_path):
    """Else the test above could not fail."""
    mark = tmp_path / "mark"
    pickle.loads(dumps(call(named("os", "system"), f"touch {mark}")))
    assert mark.exists()


def test_numpy_objects_are_refused(tmp_path):
    kind = call(named("numpy", "dtype"), "O8", False, True)
    file = write_archive(tmp_path / "net.pth", {"a": call(named("numpy.core.multiarray", "scalar"), kind, "x")}, {})
    with pytest.raises(InputError, match="NumPy objects"):
        read_torch_tensors(file)


def test_damaged_archives_are_refused(tmp_path, state):
    file = checkpoint(tmp_path / "net.pth", state)
    whole = file.read_bytes()
    for damaged in (b"", b"PK", b"<html>not found</html>", whole[:40], whole[: len(whole) // 2], whole[:-5]):
        file.write_bytes(damaged)
        with pytest.raises(InputError, match=r"net\.pth"):
            read_torch_tensors(file)
    at = whole.index(np.ascontiguousarray(state["fc1.weight"]).tobytes())
    file.write_bytes(whole[: at + 9] + bytes([whole[at + 9] ^ 1]) + whole[at + 10 :])
    with pytest.raises(InputError, match=r"net\.pth is damaged"):
        read_torch_tensors(file)
    with pytest.raises(InputError, match="no file"):
        read_torch_tensors(tmp_path / "nowhere.pth")


@pytest.mark.parametrize(
    ("offset", "shape", "strides"),
    [
        (0, (25,), (1,)),
        (1, (24,), (1,)),
        (0, (4, 6), (7, 1)),
        (0, (9999999,), (0,)),
        (-1, (2,), (1,)),
        (5, (2,), (-1,)),
    ],
)
def test_tensors_that_leave_their_storage_are_refused(tmp_path, offset, shape, strides):
    content = {"a": view(storage("0", "FloatStorage", 24), offset, shape, strides)}
    file = write_archive(tmp_path / "net.pth", content, {"0": bytes(96)})
    with pytest.raises(InputError, match=r"net\.pth.*storage"):
        read_torch_tensors(file)


def test_missing_and_mismatched_storages_are_named(tmp_path):
    content = {"a": view(storage("0", "FloatStorage", 24), 0, (24,), (1,))}
    for data, problem in (({}, "missing"), ({"0": bytes(95)}, "95 bytes instead of 24 x 4")):
        with pytest.raises(InputError, match=problem):
            read_torch_tensors(write_archive(tmp_path / "net.pth", content, data))


@pytest.mark.parametrize("content", [{}, {"epoch": 3}, [1, 2], {"model_state_dict": {"a": 1.0}}, {1: 2}])
def test_files_without_a_state_dictionary_are_refused(tmp_path, content):
    with pytest.raises(InputError, match=r"state_dict"):
        read_torch_tensors(write_archive(tmp_path / "net.pth", content, {}))


def test_tensors_that_make_no_classifier_are_named(tmp_path, state):
    def problem(changes, without=()):
        arrays = {name: array for name, array in {**state, **changes}.items() if name not in without}
        with pytest.raises(InputError, match=r"net\.pth does not hold") as error:
            load_torch_checkpoint(checkpoint(tmp_path / "net.pth", arrays))
        return str(error.value)

    ones = np.ones((4, 9), np.float32)
    assert "sa2.mlp_bns.1.running_var is missing" in problem({}, ["sa2.mlp_bns.1.running_var"])
    assert "sa1.mlp_convs.0.weight is missing" in problem({}, ["sa1.mlp_convs.0.weight"])
    assert "fc3.weight has shape (4, 9); expected (any, 6)" in problem({"fc3.weight": ones})
    assert "takes 9 inputs" in problem({"sa1.mlp_convs.0.weight": ones})
    assert "sa3.mlp_bns.0.bias has shape (4, 9)" in problem({"sa3.mlp_bns.0.bias": ones})
    assert "negative" in problem({"bn1.running_var": -state["bn1.running_var"]})
    assert "not finite" in problem({"bn1.bias": np.full_like(state["bn1.bias"], np.nan)})
    assert "['fp3'] belong to another kind of network" in problem({"fp3.mlp_convs.0.weight": ones})
    assert "no place in it, such as ['fc1.extra']" in problem({"fc1.extra": ones})


def test_conversion_keeps_every_tensor(tmp_path, state):
    state["bn1.num_batches_tracked"] = np.array(11)
    state["fc1.weight"] = state["fc1.weight"].astype(np.float64)
    source = checkpoint(tmp_path / "net.pth", state)
    network = convert_checkpoint(source, tmp_path / "net.safetensors")
    written = safetensors.numpy.load_file(tmp_path / "net.safetensors")
    assert set(written) == set(state)
    for name, array in state.items():
        np.testing.assert_array_equal(written[name], array, strict=True)
    assert_same(load_checkpoint(tmp_path / "net.safetensors"), network, rtol=0)
    assert_same(load_checkpoint(source), network, rtol=0)


def test_conversion_refuses_and_leaves_nothing_behind(tmp_path, state):
    del state["fc3.bias"]
    source = checkpoint(tmp_path / "net.pth", state)
    with pytest.raises(InputError, match=r"fc3\.bias is missing"):
        convert_checkpoint(source, tmp_path / "net.safetensors")
    with pytest.raises(InputError, match=r"must end in \.safetensors"):
        convert_checkpoint(source, tmp_path / "net.npz")
    assert not list(tmp_path.glob("net.s*"))


def test_safetensors_files_that_are_damaged_or_missing(tmp_path, state):
    file = tmp_path / "state.safetensors"
    whole = file.read_bytes()
    for damaged in (b"", b"abc", whole[:50], whole[:-3]):
        file.write_bytes(damaged)
        with pytest.raises(InputError, match=r"state\.safetensors is damaged"):
            load_safetensors(file)
    with pytest.raises(InputError, match="no file"):
        load_safetensors(tmp_path / "nowhere.safetensors")
    with pytest.raises(InputError, match="cannot write"):
        save_safetensors(state, tmp_path / "nowhere" / "net.safetensors")
    with pytest.raises(InputError, match=r"\.pth or \.pt"):
        load_checkpoint(tmp_path / "net.onnx")


def test_a_network_with_other_radii_is_not_saved(tmp_path):
    other = tuple(level._replace(radii=(0.3,)) for level in SINGLE_SCALE)
    with pytest.raises(InputError, match="published"):
        save_safetensors(narrow_network(other), tmp_path / "net.safetensors")
