"""Sessions on disk: their files, and how they continue."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from small_session import BOX, FIRST, POSES, begun, session_of, shot

from jaxnbv.checks import InputError


def test_a_session_goes_on_from_its_folder(tmp_path):
    """After an image, and after a proposal, whose file is read and not computed again."""
    begun(tmp_path)
    session = session_of(tmp_path)
    assert len(session.views) == 1
    matrix = session.next().matrix
    again = session_of(tmp_path)
    files = {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("*.npz")}
    np.testing.assert_array_equal(again.next().matrix, matrix)
    np.testing.assert_array_equal(again.expected_depth(), session.expected_depth())
    assert files == {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("*.npz")}
    again.add(shot(matrix), matrix, depth_scale=1e-3)
    last = session_of(tmp_path)
    np.testing.assert_array_equal(last.next().proposal.values, record(None).episode.views[2].proposal.values)
    np.testing.assert_array_equal(last.observations.cloud.points, again.observations.cloud.points)


def test_images_keep_their_pixels_and_only_for_their_session(tmp_path):
    begun(tmp_path)
    file = tmp_path / "image_00.npz"
    with np.load(file) as saved:
        np.testing.assert_array_equal(saved["depth"], shot(FIRST))
        assert saved["depth"].dtype == np.uint16
        np.testing.assert_array_equal(saved["matrix"], FIRST)
    config = json.loads((tmp_path / "session.json").read_text())["config"]
    assert config["box"]["low"]["values"] == list(BOX[0])
    with pytest.raises(InputError, match=r"belongs to another session; it differs in up: 'z' there, 'y' now"):
        session_of(tmp_path, up="y")
    file.write_bytes(file.read_bytes()[:-40])
    with pytest.raises(InputError, match=r"image_00\.npz is damaged .*restore it, or delete it and those after it"):
        session_of(tmp_path)


def test_two_sessions_in_one_folder_do_not_overwrite_each_other(tmp_path):
    first, second = session_of(tmp_path), session_of(tmp_path)
    first.add(shot(FIRST), FIRST, depth_scale=1e-3)
    content = (tmp_path / "image_00.npz").read_bytes()
    with pytest.raises(InputError, match=r"holds 1 images, but this session knows 0"):
        second.add(shot(POSES[0]), POSES[0], depth_scale=1e-3)
    assert (tmp_path / "image_00.npz").read_bytes() == content
    assert len(second.views) == 0


SCRIPT = """
import sys
sys.path[:0] = {tests!r}
from test_session_folder import record
record(sys.argv[1])
"""


def record(folder):
    """Three images at the proposed poses, and the next proposal."""
    session = session_of(folder)
    while len(session.views) < 3:
        matrix = FIRST if len(session.views) == 0 else session.next().matrix
        session.add(shot(matrix), matrix, depth_scale=1e-3)
    session.next()
    return session


@pytest.mark.slow
def test_a_session_that_was_killed_ends_as_one_that_was_not(tmp_path):
    script = SCRIPT.format(tests=[str(folder) for folder in Path(__file__).parents[:2]])
    process = subprocess.Popen([sys.executable, "-c", script, str(tmp_path / "killed")])
    while process.poll() is None and not (tmp_path / "killed" / "image_01.npz").exists():
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    for name in ("killed", "whole"):
        record(tmp_path / name)

    def contents(folder):
        return {path.name: path.read_bytes() for path in sorted(folder.glob("*_*.npz"))}

    whole = contents(tmp_path / "whole")
    assert len(whole) == 6
    assert contents(tmp_path / "killed") == whole
