"""Processes that are killed and started again, and two processes in one folder."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from small_episode import contents, run

from jaxnbv.checks import InputError

ROOT = Path(__file__).resolve().parents[2]

SCRIPT = """
import os, sys, time
from pathlib import Path
import jaxnbv.planning.simulate, jaxnbv.storage.files
from small_episode import run

folder, stage, view = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])

def stall_at(module, name, moment):
    original, calls = getattr(module, name), [0]
    def replacement(*arguments):
        calls[0] += 1
        if moment(calls[0]):
            folder.with_suffix(".stalled").touch()
            time.sleep(600)
        return original(*arguments)
    setattr(module, name, replacement)

done = len(list(folder.glob("view_*.npz")))
if stage == "scan":
    stall_at(jaxnbv.planning.simulate, "observe_scene", lambda call: done + call == view + 1)
if stage == "write":
    record = 0 if (folder / "episode.json").exists() else 1
    stall_at(jaxnbv.storage.files.os, "fsync", lambda call: done + call == view + 1 + record)
run(folder, views=5)
"""


def start(folder, stage="none", view=0):
    command = [sys.executable, "-c", SCRIPT, str(folder), stage, str(view)]
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(str(folder) for folder in (ROOT, *Path(__file__).parents[:2])),
        "JAX_COMPILATION_CACHE_DIR": str(folder.with_name("compiled")),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        # The promise is about programs as users run them.
        "XLA_FLAGS": "",
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "0",
    }
    return subprocess.Popen(command, env=environment, stderr=subprocess.PIPE)


def kill_once(process, reached):
    """Send SIGKILL as soon as `reached()`. The process must still be running then."""
    deadline = time.monotonic() + 300
    while not reached():
        if process.poll() is not None:
            pytest.fail(f"it ended before it could be killed: {process.stderr.read().decode()}")
        assert time.monotonic() < deadline
        time.sleep(0.005)
    process.kill()
    process.communicate()
    assert process.returncode == -signal.SIGKILL


@pytest.mark.slow
def test_killed_at_any_moment_and_started_again_it_ends_with_the_same_files(tmp_path):
    """Once when the first view appears, once half-way through writing the second, and once while the third is
    scanned."""
    folder, stalled = tmp_path / "killed", tmp_path / "killed.stalled"
    # This run compiles the programs for the others, which are then killed while nothing is compiled.
    uninterrupted = start(tmp_path / "whole")
    assert uninterrupted.wait(timeout=300) == 0, uninterrupted.stderr.read().decode()
    kill_once(start(folder), (folder / "view_00.npz").exists)
    assert "cloud.ply" not in contents(folder)

    kill_once(start(folder, "write", 1), stalled.exists)
    assert list(folder.glob(".*.partial"))
    assert not (folder / "view_01.npz").exists()
    stalled.unlink()

    kill_once(start(folder, "scan", 2), stalled.exists)
    assert (folder / "view_01.npz").exists()
    assert not (folder / "view_02.npz").exists()

    process = start(folder)
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors.decode()
    assert contents(folder) == contents(tmp_path / "whole")


def test_one_process_writes_at_a_time(tmp_path):
    run(tmp_path, views=1)
    before = contents(tmp_path)
    script = (
        "import sys\nfrom pathlib import Path\nfrom jaxnbv.storage.folders import writing_in\n"
        "with writing_in(Path(sys.argv[1])):\n"
        "    print('holding', flush=True)\n    sys.stdin.read()\n"
    )
    holder = subprocess.Popen([sys.executable, "-c", script, tmp_path], stdin=-1, stdout=-1, text=True)
    assert holder.stdout.readline() == "holding\n"
    with pytest.raises(InputError, match=r"is being written by another process: wait until it ends"):
        run(tmp_path, views=1)
    holder.kill()
    holder.communicate()
    run(tmp_path, views=1)
    assert contents(tmp_path) == before
