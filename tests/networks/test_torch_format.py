"""PyTorch files written by hand: read as they are meant, or refused."""

import copy
import pickle
import subprocess
import sys
import zipfile

import numpy as np
import pytest
import safetensors.numpy
from torch_files import (
    STORAGES,
    Op,
    call,
    checkpoint,
    dumps,
    named,
    narrow_network,
    program,
    state_of,
    storage,
    tensors_and_bytes,
    view,
    write_archive,
    write_stream,
)

from jaxnbv.checks import InputError
from jaxnbv.networks import (
    read_torch_tensors,
    save_checkpoint,
)

RNG = np.random.default_rng(0)


@pytest.fixture
def state(tmp_path):
    return state_of(narrow_network(), tmp_path)


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
    save_checkpoint(tensors, tmp_path / "net.safetensors")
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


def nested(depth):
    """A tuple of two that is 2^depth long when it is written out, by a program of some four bytes a level."""
    steps = b"".join(b"q" + bytes([index]) + b"h" + bytes([index]) + b"\x86" for index in range(depth))
    return Op(b"K\x01K\x02\x86" + steps)


def refusals(*files):
    """Their messages, from a process that may take 300 MB and half a minute."""
    script = """
import resource, sys
from jaxnbv.checks import InputError
from jaxnbv.networks import read_torch_tensors
held = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (held + 300 * 2**20,) * 2)
resource.setrlimit(resource.RLIMIT_CPU, (30, 30))
for file in sys.argv[1:]:
    try:
        read_torch_tensors(file)
    except InputError as error:
        print(str(error)[:1000])
"""
    run = subprocess.run([sys.executable, "-c", script, *files], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    messages = run.stdout.splitlines()
    assert len(messages) == len(files)
    return messages


def short_programs(folder):
    """For huge values."""
    huge, stored = nested(60), named("torch", "FloatStorage")
    contents = (
        {"a": Op(b"Q", ("storage", huge, "0", "cpu", 1))},
        {"a": Op(b"Q", ("storage", stored, huge, "cpu", 1))},
        {huge: 1},
        {"a": call(named("collections", "OrderedDict"), [(huge, 1)])},
        {"a": huge},
    )
    return [write_archive(folder / f"short{index}.pth", content, {}) for index, content in enumerate(contents)]


def repeated_copies(folder):
    """Calls that copy the same again and again."""
    pairs = dumps([(str(index), None) for index in range(30_000)])[2:-1]
    of_pairs = Op(pairs + b"q\x00ccollections\nOrderedDict\nq\x01" + 3000 * b"h\x01h\x00\x85R")
    text = program("a" * 1_000_000) + b"q\x00" + program("latin1") + b"q\x01c_codecs\nencode\nq\x02"
    of_text = Op(text + 3000 * b"h\x02h\x00h\x01\x86R")
    return [
        write_archive(folder / f"copies{index}.pth", {"a": content}, {})
        for index, content in enumerate((of_pairs, of_text))
    ]


def declared_sizes(folder):
    """An index of the memo, the lengths of a text, of a longer one and of an integer, in both layouts."""
    files = []
    for size in (b"r\xff\xff\xff\xff", b"X\xff\xff\xff\x7f", b"\x8d" + b"\xff" * 5 + bytes(3), b"\x8b\xff\xff\xff\x7f"):
        files.append(write_archive(folder / f"{len(files)}.pth", {"a": Op(b"K\x01" + size)}, {}))
        files.append(folder / f"{len(files)}.pth")
        files[-1].write_bytes(b"\x80\x02K\x01" + size + b".")
    return files


def test_what_is_short_but_would_take_much_is_refused_at_once(tmp_path):
    short, copying = short_programs(tmp_path), repeated_copies(tmp_path)
    messages = refusals(*short, *copying, *declared_sizes(tmp_path))
    assert all("nested too deep" in message for message in messages[: len(short)])
    assert all("copy more than the file holds" in message for message in messages[len(short) :][: len(copying)])


def test_keys_that_are_no_names_are_refused(tmp_path):
    with pytest.raises(InputError, match="neither a string nor an integer"):
        read_torch_tensors(write_archive(tmp_path / "net.pth", {(1, 2): 1}, {}))


@pytest.mark.slow
def test_members_that_are_compressed_or_shared_are_refused(tmp_path):
    count = 2**26
    content = {"a": view(storage("0", "FloatStorage", count), 0, (count,), (1,))}
    file = tmp_path / "net.pth"
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("net/data.pkl", dumps(content), zipfile.ZIP_STORED)
        with archive.open("net/data/0", "w") as member:
            for _ in range(2**8):
                member.write(bytes(2**20))
    assert file.stat().st_size < 2**20
    assert "compressed" in refusals(file)[0]
    # One member's bytes under many names.
    arrays = {f"a{index}": np.zeros(1000, np.float32) for index in range(4)}
    tensors, data = tensors_and_bytes(arrays)
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("net/data.pkl", dumps(tensors))
        archive.writestr("net/data/0", data["0"])
        one = archive.getinfo("net/data/0")
        for index in (1, 2, 3):
            other = copy.copy(one)
            other.filename = f"net/data/{index}"
            archive.filelist.append(other)
            archive.NameToInfo[other.filename] = other
    with pytest.raises(InputError, match=r"longer than the file|damaged"):
        read_torch_tensors(file)


def test_storages_of_the_older_layout_are_no_longer_than_the_file_all_together(tmp_path):
    arrays = {f"a{index}": np.zeros(1000, np.float32) for index in range(4)}
    content, data = tensors_and_bytes(arrays, None)
    file = write_stream(tmp_path / "net.pth", content, {"0": data["0"]}, [1000])
    with pytest.raises(InputError, match="larger than the file"):
        read_torch_tensors(file)


def test_operations_that_no_tensor_needs_are_refused(tmp_path):
    for body in (b"\x8f", b"c__builtin__\nset\n)\x81", b"(ios\nsystem\n"):
        with pytest.raises(InputError, match=r"refused"):
            read_torch_tensors(write_archive(tmp_path / "net.pth", {"a": Op(body)}, {}))


def test_storages_that_an_older_file_does_not_fill_are_refused(tmp_path, state):
    content, data = tensors_and_bytes(state, None)
    first = dict(list(data.items())[:1])
    file = write_stream(tmp_path / "net.pth", content, first, [next(iter(state.values())).size])
    with pytest.raises(InputError, match=rf"lists 1 storages where its tensors need {len(state)}"):
        read_torch_tensors(file)


def test_a_long_name_does_not_make_a_long_message(tmp_path):
    file = write_archive(tmp_path / "net.pth", {"n" * 1_000_000: 1}, {})
    with pytest.raises(InputError, match=r"is not a tensor|nnn") as error:
        read_torch_tensors(file)
    assert len(str(error.value)) < 700
