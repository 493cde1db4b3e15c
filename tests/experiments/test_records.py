"""Records of a study on disk."""

import pytest

from jaxnbv.checks import InputError
from jaxnbv.experiments.records import RecordFolder


def test_records_are_kept_and_the_missing_ones_made(tmp_path):
    asked = []

    def run(index):
        asked.append(index)
        if index == 2 and len(asked) == 3:
            raise KeyboardInterrupt
        return {"scene": index, "value": 0.1 * index}

    config = {"views": 3, "radii": (1, 2)}
    with pytest.raises(KeyboardInterrupt):
        RecordFolder(tmp_path / "a" / "b", config).collect(4, run, progress=False)
    found = RecordFolder(tmp_path / "a" / "b", config).collect(4, run, progress=False)
    assert asked == [0, 1, 2, 2, 3]
    assert found == [{"scene": index, "value": 0.1 * index} for index in range(4)]
    assert RecordFolder(tmp_path / "a" / "b", config).collect(2, run, progress=False) == found[:2]
    assert len(asked) == 5
    (tmp_path / "a" / "b" / "scene_0001.json").unlink()
    assert RecordFolder(tmp_path / "a" / "b", config).collect(4, run, progress=False) == found
    assert asked[5:] == [1]


def test_folders_of_another_study_and_damaged_records_are_refused(tmp_path):
    RecordFolder(tmp_path, {"views": 3, "framing": "whole"}).collect(1, lambda index: {"scene": index}, progress=False)
    with pytest.raises(InputError, match="another study; it differs in views: 3 there, 4 now"):
        RecordFolder(tmp_path, {"views": 4, "framing": "whole"})
    for damaged in (b'{"scene": ', b"", b"\xff\xfe\x00"):
        (tmp_path / "scene_0000.json").write_bytes(damaged)
        with pytest.raises(InputError, match=r"scene_0000\.json is damaged"):
            RecordFolder(tmp_path, {"views": 3, "framing": "whole"}).collect(1, lambda index: {}, progress=False)
    (tmp_path / "study.json").write_bytes(b"[")
    with pytest.raises(InputError, match=r"study\.json is damaged"):
        RecordFolder(tmp_path, {"views": 3, "framing": "whole"})
    (tmp_path / "file").write_text("here")
    with pytest.raises(InputError, match="cannot make the output folder"):
        RecordFolder(tmp_path / "file", {"views": 3})
