"""Records of a study on disk."""

import functools
import json

import pytest

from jaxnbv.checks import InputError
from jaxnbv.studies.engine.records import RecordFolder


def test_records_are_kept_and_the_missing_ones_made(tmp_path):
    calls = []

    def run(index):
        calls.append(index)
        if index == 2 and len(calls) == 3:
            raise KeyboardInterrupt
        return {"scene": index, "value": 0.1 * index}

    config = {"views": 3, "radii": (1, 2)}
    with pytest.raises(KeyboardInterrupt):
        RecordFolder(tmp_path / "a" / "b", config).collect(range(4), run, progress=False)
    records = RecordFolder(tmp_path / "a" / "b", config).collect(range(4), run, progress=False)
    assert calls == [0, 1, 2, 2, 3]
    assert records == [{"scene": index, "value": 0.1 * index} for index in range(4)]
    assert RecordFolder(tmp_path / "a" / "b", config).collect(range(2), run, progress=False) == records[:2]
    assert len(calls) == 5
    (tmp_path / "a" / "b" / "scene_0001.json").unlink()
    assert RecordFolder(tmp_path / "a" / "b", config).collect(range(4), run, progress=False) == records
    assert calls[5:] == [1]


def test_folders_of_another_study_are_refused(tmp_path):
    config = {"views": 3, "framing": "whole"}
    RecordFolder(tmp_path, config).collect(range(1), lambda index: {"scene": index}, progress=False)
    with pytest.raises(InputError, match="another study; it differs in views: 3 there, 4 now"):
        RecordFolder(tmp_path, config | {"views": 4})
    (tmp_path / "study.json").write_bytes(b"[")
    with pytest.raises(InputError, match=r"study\.json is no study record"):
        RecordFolder(tmp_path, config)
    (tmp_path / "file").write_text("here")
    with pytest.raises(InputError, match="cannot make the output folder"):
        RecordFolder(tmp_path / "file", config)


def test_records_that_are_not_what_they_were_are_refused(tmp_path):
    config = {"views": 3}

    def collect(count=2):
        return RecordFolder(tmp_path, config).collect(
            range(count), lambda index: {"scene": index, "x": [0.25]}, progress=False
        )

    expected = collect()
    file, whole = tmp_path / "scene_0001.json", (tmp_path / "scene_0001.json").read_text()
    for changed, problem in (
        (whole.replace("0.25", "0.26"), "checksum"),
        ((tmp_path / "scene_0000.json").read_text(), "it is scene 0"),
        ("", "Expecting value"),
        ("[]", "it holds a list"),
        ("[" * 100_000, "recursion"),
        ('{"format": 2, "index": 1, "record": [], "sha256": ""}', "checksum"),
    ):
        assert changed != whole
        file.write_text(changed)
        with pytest.raises(InputError, match=rf"scene_0001\.json is damaged .*{problem}.*delete it"):
            collect()
    file.write_text('{"format": 3}')
    with pytest.raises(InputError, match="format 3"):
        collect()
    file.unlink()
    assert collect() == expected
    for changed in ("[]", "null", "7"):
        (tmp_path / "study.json").write_text(changed)
        with pytest.raises(InputError, match=r"study\.json is no study record .*choose another"):
            collect()


def test_records_of_several_folders_are_joined(tmp_path):
    def record(index, seconds=1.0):
        return {"x": index / 3, "steps": [{"seconds": seconds}]}

    def collect(name, scenes, seconds):
        run = functools.partial(record, seconds=seconds)
        RecordFolder(tmp_path / name, {"views": 3}).collect(scenes, run, progress=False)

    collect("a", range(0, 3), 1.0)
    collect("b", range(2, 4), 2.0)
    written = json.loads((tmp_path / "a" / "study.json").read_text())
    written["versions"]["cores"] = 77
    (tmp_path / "a" / "study.json").write_text(json.dumps(written))
    joined = RecordFolder(tmp_path / "joined", {"views": 3})
    with pytest.warns(UserWarning, match="cores: 77 there"):
        joined.join([tmp_path / "a", tmp_path / "b"])
    assert json.loads((tmp_path / "joined" / "study.json").read_text())["versions"]["cores"] == 77
    calls = []
    with pytest.warns(UserWarning, match="cores: 77 there"):
        records = joined.collect(range(5), lambda index: calls.append(index) or record(index), progress=False)
    assert records == [record(0), record(1), record(2), record(3, 2.0), record(4)]
    assert calls == [4]
    # Joining a folder again changes nothing.
    joined.join([tmp_path / "a"])
    assert joined.collect(range(5), calls.append, progress=False) == records


def test_folders_that_do_not_belong_together_are_not_joined(tmp_path):
    for name, views, value in (("a", 3, 0.5), ("other", 4, 0.5), ("wrong", 3, 0.25)):
        RecordFolder(tmp_path / name, {"views": views}).collect(range(1), lambda _, x=value: {"x": x}, progress=False)
    joined = RecordFolder(tmp_path / "joined", {"views": 3})
    with pytest.raises(
        InputError, match=r"other has other settings than .*joined; it differs in views: 4 there, 3 now"
    ):
        joined.join([tmp_path / "a", tmp_path / "other"])
    with pytest.raises(
        InputError, match=r"wrong.scene_0000\.json and .*joined.scene_0000\.json differ in x: 0.25 there"
    ):
        joined.join([tmp_path / "wrong"])
    with pytest.raises(InputError, match=r"nowhere.study\.json is no study record .*leave it out"):
        joined.join([tmp_path / "nowhere"])
    (tmp_path / "wrong" / "scene_0000.json").write_text("{")
    with pytest.raises(InputError, match=r"wrong.scene_0000\.json is damaged"):
        joined.join([tmp_path / "wrong"])
    assert joined.collect(range(1), lambda index: {}, progress=False) == [{"x": 0.5}]


def test_keys_that_are_numbers_are_read_as_text(tmp_path):
    records = RecordFolder(tmp_path, {}).collect(range(1), lambda index: {"by view": {10: 1.5, 9: 0.5}}, progress=False)
    assert records == [{"by view": {"10": 1.5, "9": 0.5}}]


def test_a_failed_study_leaves_its_folder_free(tmp_path):
    def fail(index):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        RecordFolder(tmp_path, {"views": 3}).collect(range(1), fail, progress=False)
    assert RecordFolder(tmp_path, {"views": 4}).collect(range(1), lambda index: {}, progress=False) == [{}]
