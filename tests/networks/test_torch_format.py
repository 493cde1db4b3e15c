"""PyTorch files written by hand are read as intended, or refused. Nothing in them is executed."""

import pickle
import resource
import struct
import tracemalloc
import zipfile

import numpy as np
import pytest
from published_networks import classifier_state
from torch_files import (
    STORAGES,
    Op,
    call,
    checkpoint,
    dumps,
    named,
    program,
    storage,
    tensors_and_bytes,
    view,
    write_archive,
    write_stream,
)

import jaxnbv as nbv
from jaxnbv.networks.torch_format import read_torch_tensors

RNG = np.random.default_rng(0)


@pytest.fixture
def state():
    return classifier_state(RNG, "ssg", 6)


def test_tensors_of_every_type(tmp_path):
    arrays = {kind: RNG.uniform(0, 9, (2, 3, 4)).astype(kind) for kind in STORAGES}
    arrays["scalar"] = np.array(5, np.int64)
    content, data = tensors_and_bytes(arrays)
    tensors = read_torch_tensors(write_archive(tmp_path / "net.pth", content, data))
    for name, array in arrays.items():
        np.testing.assert_array_equal(tensors[name], array)
        assert tensors[name].dtype == array.dtype


def test_bfloat16(tmp_path):
    values = np.array([1.0, -2.5, 0.15625], np.float32)
    bits = (values.view(np.uint32) >> 16).astype(np.uint16)
    content = {"a": view(storage("0", "BFloat16Storage", 3), 0, (3,), (1,))}
    tensors = read_torch_tensors(write_archive(tmp_path / "net.pth", content, {"0": bits.tobytes()}))
    np.testing.assert_array_equal(tensors["a"].astype(np.float32), values)


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
    tensors = read_torch_tensors(write_archive(tmp_path / "net.pth", content, {"0": numbers.tobytes()}))
    np.testing.assert_array_equal(tensors["transposed"], numbers.reshape(4, 6).T)
    np.testing.assert_array_equal(tensors["part"], 5 + np.array([[0, 2, 4], [8, 10, 12]]))
    np.testing.assert_array_equal(tensors["parameter"], [23])
    assert tensors["none"].shape == (0, 3)


def test_the_older_layout(tmp_path, state):
    content, data = tensors_and_bytes(state, None)
    file = write_stream(tmp_path / "net.pth", content, data, [array.size for array in state.values()])
    for name, array in read_torch_tensors(file).items():
        np.testing.assert_array_equal(array, state[name])
    whole = file.read_bytes()
    for cut in (1, 5, 30, len(whole) // 2, len(whole) - 1):
        file.write_bytes(whole[:cut])
        with pytest.raises(nbv.InputError, match=r"net\.pth"):
            read_torch_tensors(file)


@pytest.mark.parametrize(
    ("module", "name"),
    [("os", "system"), ("posix", "system"), ("builtins", "eval"), ("builtins", "getattr"), ("torch", "load")],
)
@pytest.mark.parametrize("layout", ["archive", "stream", "alone"])
def test_other_code_in_a_file_is_not_run(tmp_path, module, name, layout):
    mark = tmp_path / "mark"
    attack = {"a": call(named(module, name), f"open({str(mark)!r}, 'w')" if name == "eval" else f"touch {mark}")}
    file = tmp_path / "net.pth"
    if layout == "archive":
        write_archive(file, attack, {})
    elif layout == "stream":
        write_stream(file, attack, {}, [])
    else:
        file.write_bytes(dumps(attack))
    with pytest.raises(nbv.InputError, match=r"net\.pth"):
        read_torch_tensors(file)
    assert not mark.exists()


def test_the_attack_would_have_worked(tmp_path):
    """Without this the test above could not fail."""
    mark = tmp_path / "mark"
    pickle.loads(dumps(call(named("os", "system"), f"touch {mark}")))
    assert mark.exists()


def test_other_data_of_a_training_run_is_ignored(tmp_path, state):
    """A NumPy number, settings of an own class, and a function, in the forms that pickles have."""
    kind = Op(b"b", call(named("numpy", "dtype"), "f8", False, True), (3, "<", None, None, None, -1, -1, 0))
    text = call(named("_codecs", "encode"), struct.pack("<d", 0.875).decode("latin1"), "latin1")
    others = {
        "class_acc": call(named("numpy.core.multiarray", "scalar"), kind, text),
        "args": Op(b"b", Op(b"\x81", named("argparse", "Namespace"), ()), {"batch_size": 24}),
        "model": named("models.pointnet2_cls_ssg", "get_model"),
    }
    tensors = read_torch_tensors(checkpoint(tmp_path / "net.pth", state, **others))
    assert set(tensors) == set(state)


def test_damaged_archives_are_refused(tmp_path, state):
    file = checkpoint(tmp_path / "net.pth", state)
    whole = file.read_bytes()
    for damaged in (b"", b"PK", b"<html>not found</html>", whole[:40], whole[: len(whole) // 2], whole[:-5]):
        file.write_bytes(damaged)
        with pytest.raises(nbv.InputError, match=r"net\.pth"):
            read_torch_tensors(file)
    at = whole.index(np.ascontiguousarray(state["fc1.weight"]).tobytes())
    file.write_bytes(whole[: at + 9] + bytes([whole[at + 9] ^ 1]) + whole[at + 10 :])
    with pytest.raises(nbv.InputError, match=r"net\.pth is damaged"):
        read_torch_tensors(file)
    with pytest.raises(nbv.InputError, match="no file"):
        read_torch_tensors(tmp_path / "nowhere.pth")


@pytest.mark.parametrize(
    ("offset", "shape", "strides"),
    [
        (0, (25,), (1,)),
        (1, (24,), (1,)),
        (0, (4, 6), (7, 1)),
        (-1, (2,), (1,)),
        (0, (2,), (-1,)),
    ],
)
def test_tensors_that_leave_their_storage_are_refused(tmp_path, offset, shape, strides):
    content = {"a": view(storage("0", "FloatStorage", 24), offset, shape, strides)}
    file = write_archive(tmp_path / "net.pth", content, {"0": bytes(96)})
    with pytest.raises(nbv.InputError, match=r"net\.pth is damaged"):
        read_torch_tensors(file)


def test_missing_and_mismatched_storages_are_named(tmp_path):
    content = {"a": view(storage("0", "FloatStorage", 24), 0, (24,), (1,))}
    for data, problem in (({}, "net/data/0"), ({"0": bytes(95)}, "buffer is smaller")):
        with pytest.raises(nbv.InputError, match=problem):
            read_torch_tensors(write_archive(tmp_path / "net.pth", content, data))


@pytest.mark.parametrize("content", [{}, {"epoch": 3}, [1, 2], {"model_state_dict": {"a": 1.0}}, {1: 2}])
def test_files_without_a_state_dictionary_are_refused(tmp_path, content):
    with pytest.raises(nbv.InputError, match=r"state_dict"):
        read_torch_tensors(write_archive(tmp_path / "net.pth", content, {}))


def test_storages_that_an_older_file_does_not_fill_are_refused(tmp_path, state):
    content, data = tensors_and_bytes(state, None)
    first = dict(list(data.items())[:1])
    file = write_stream(tmp_path / "net.pth", content, first, [next(iter(state.values())).size])
    with pytest.raises(nbv.InputError, match="lists other storages than its tensors need"):
        read_torch_tensors(file)


def copies(count, step):
    """Many dictionaries with the same entries: memo 1 makes one, 2 has the pairs, 3 has them as a dictionary."""
    pairs = [(f"k{index:05d}", 1) for index in range(count)]
    head = b"\x80\x02ccollections\nOrderedDict\nq\x01" + program([list(pair) for pair in pairs]) + b"q\x02"
    return head + program(dict(pairs)) + b"q\x03" + b"(" + step * count + b"l."


LONG = struct.pack("<I", 2**31 - 1)
BOMBS = {
    "memo of 67 million": b"\x80\x02]r\x00\x00\x00\x04.",
    "memo in text": b"]p67108864\n.",
    "later memo": b"\x80\x02](NNNNr\x00\x00\x00\x01e.",
    "text of 2 GB": b"\x80\x02X" + LONG + b".",
    "bytes of 2 GB": b"\x80\x03B" + LONG + b".",
    "text of 16 EB": b"\x80\x04\x8d" + b"\xff" * 8 + b".",
    "buffer of 4 TB": b"\x80\x05\x96" + struct.pack("<Q", 2**42) + b".",
    "number of 2 GB": b"\x80\x02\x8b" + LONG + b".",
    "frame of 2 GB": b"\x80\x04\x95" + struct.pack("<Q", 2**31) + b"N.",
    "frame of 4 TB": b"\x80\x04\x95" + struct.pack("<Q", 2**42) + b"N.",
    "tuples in tuples": b"\x80\x02}N" + b"\x85" * 1_000_000 + b"Ns.",
    "tuples in tuples, remembered": b"\x80\x02}N" + b"\x85q\x00h\x00\x86" * 200_000 + b"Ns.",
    "one array of 8 TB": dumps({"a": view(storage("0", "DoubleStorage", 2**40), 0, (1,), (1,))}),
    "many arrays": dumps({str(i): view(storage(str(i), "DoubleStorage", 400), 0, (1,), (1,)) for i in range(40)}),
    "copies": copies(700, b"h\x01h\x02\x85R"),
    "copies beside": copies(700, b"h\x01)Rh\x03b"),
    "nothing taken": b"\x80\x02\x85.",
    "a mark that is none": b"\x80\x02t.",
}


@pytest.mark.parametrize("name", BOMBS)
@pytest.mark.parametrize("layout", ["alone", "stream", "archive"])
def test_memory_is_bounded_by_the_size_of_the_file(tmp_path, name, layout):
    file = tmp_path / "net.pth"
    if layout == "archive":
        with zipfile.ZipFile(file, "w") as archive:
            archive.writestr("net/data.pkl", BOMBS[name])
    else:
        head = [0x1950A86A20F9469CFC6C, 1001, {"little_endian": True}] if layout == "stream" else []
        file.write_bytes(b"".join(map(dumps, head)) + BOMBS[name])
    tracemalloc.start()
    with pytest.raises(nbv.InputError, match=r"net\.pth"):
        read_torch_tensors(file)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2**20 + 200 * file.stat().st_size


def test_a_file_of_ten_bytes_takes_no_gigabyte(tmp_path):
    """Python's own reader would allocate it. Memory that NumPy and Python do not trace counts too."""
    file = tmp_path / "net.pth"
    file.write_bytes(b"\x80\x02]r\x00\x00\x00\x04.")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(nbv.InputError, match="asks for room for 67108864 things"):
        read_torch_tensors(file)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000


def test_compressed_and_stretched_arrays_are_refused(tmp_path):
    content = {"a": view(storage("0", "DoubleStorage", 2**20), 0, (1,), (1,))}
    file = write_archive(tmp_path / "net.pth", content, {"0": bytes(2**23)})
    assert read_torch_tensors(file)["a"].shape == (1,)
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("net/data.pkl", dumps(content))
        archive.writestr("net/data/0", bytes(2**23))
    with pytest.raises(nbv.InputError, match="unpacks to"):
        read_torch_tensors(file)
    content = {"a": view(storage("0", "DoubleStorage", 1), 0, (2**40,), (0,))}
    with pytest.raises(nbv.InputError, match="to a tensor of shape"):
        read_torch_tensors(write_archive(file, content, {"0": bytes(8)}))


def test_a_storage_that_many_tensors_share_is_read_once(tmp_path):
    shared = storage("0", "DoubleStorage", 2**17)
    content = {str(row): view(shared, row, (1,), (1,)) for row in range(100)}
    file = write_archive(tmp_path / "net.pth", content, {"0": np.arange(2.0**17).tobytes()})
    tracemalloc.start()
    tensors = read_torch_tensors(file)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert [float(tensors[str(row)][0]) for row in range(100)] == list(range(100))
    assert peak < 6 * 2**20


def test_long_lists_and_deep_settings_are_read(tmp_path, state):
    """Older protocols write one item at a time. The nesting is deep, but not too deep."""
    deep = ()
    for _ in range(300):
        deep = (deep,)
    items = Op(b"".join(b"K\x01a" for _ in range(3000)), [])
    tensors = read_torch_tensors(checkpoint(tmp_path / "net.pth", state, losses=items, settings=deep))
    assert set(tensors) == set(state)
