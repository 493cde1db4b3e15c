"""Trials in this process and in others."""

import functools
import json
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import loky
import psutil
import pytest
from deadly import Trial
from test_study import small, without_time
from toy import ToyStudy

from jaxnbv.checks import InputError
from jaxnbv.cli import run_study as command
from jaxnbv.cli.study_options import StudyOptions
from jaxnbv.storage.folders import num_threads, versions
from jaxnbv.studies.engine.processes import Processes
from jaxnbv.studies.engine.records import RecordFolder
from jaxnbv.studies.engine.run import run_scene
from jaxnbv.studies.engine.trials import outcomes
from jaxnbv.studies.registry import Entry, studies


def squares(*indices):
    return [{"square": index * index} for index in indices]


@pytest.mark.slow
def test_no_trial_is_lost_though_some_die(tmp_path):
    trial = Trial(tmp_path)
    with Processes(2) as processes:
        records = RecordFolder(tmp_path / "records", {"views": 3}, processes)
        assert records.collect(range(6), trial, progress=False) == squares(0, 1, 2, 5)
    assert [len(trial.beginnings(index)) for index in range(6)] == [1, 1, 2, 1, 2, 1]
    failures = records.failures(range(6))
    assert list(failures) == [3, 4]
    assert failures[3] == "RuntimeError: the third never works"
    assert "died 2 times" in failures[4]
    assert list(records.failures(range(4))) == [3]
    assert "in __call__" in (tmp_path / "records" / "scene_0003.failed").read_text()
    # The next time only the failed ones run.
    calls = []
    again = RecordFolder(tmp_path / "records", {"views": 3})
    assert again.collect(range(6), lambda index: calls.append(index) or {"square": index**2}) == squares(*range(6))
    assert calls == [3, 4]
    assert again.failures(range(6)) == {}


@pytest.mark.slow
def test_processes_end_when_the_command_is_killed(tmp_path):
    program = (
        "from pathlib import Path; from deadly import Endless; from jaxnbv.studies.engine.processes import Processes;"
        "from jaxnbv.studies.engine.trials import outcomes;"
        f"list(outcomes(Endless(Path({str(tmp_path)!r})), [0], Processes(2)))"
    )
    folder = str(Path(__file__).parent)
    command = subprocess.Popen([sys.executable, "-c", program], env=os.environ | {"PYTHONPATH": folder})
    wait_until(lambda: any(tmp_path.iterdir()) or command.poll() is not None)
    (begun,) = tmp_path.iterdir()
    assert is_running(int(begun.name))
    command.send_signal(signal.SIGKILL)
    command.wait()
    wait_until(lambda: not is_running(int(begun.name)))


def wait_until(happened, seconds=60):
    end = time.monotonic() + seconds
    while not happened():
        assert time.monotonic() < end, f"it did not happen in {seconds} s"
        time.sleep(0.1)


def is_running(process):
    try:
        return psutil.Process(process).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


@pytest.mark.slow
def test_a_study_in_processes_finds_what_it_finds_here(tmp_path):
    trial = functools.partial(run_scene, small(num_candidates=4, views=2))
    here = RecordFolder(tmp_path / "here", {}).collect(range(2), trial, progress=False)
    with Processes(2) as processes:
        there = RecordFolder(tmp_path / "there", {}, processes).collect(range(2), trial, progress=False)
    assert list(map(without_time, here)) == list(map(without_time, there))


def test_processes_share_the_cores():
    share = max(loky.cpu_count() // 2, 1)
    with Processes(2) as processes:
        assert processes.submit(lambda: (loky.cpu_count(), num_threads())).result() == (share, share)


def test_any_executor_runs_trials_and_the_folder_says_where(tmp_path):
    with ThreadPoolExecutor(3) as threads:
        records = RecordFolder(tmp_path, {}, threads)
        assert records.collect(range(6), lambda index: {"square": index**2}, progress=False) == squares(*range(6))
    assert json.loads((tmp_path / "study.json").read_text())["versions"] == versions()


def test_leaving_early_cancels_the_trials_that_have_not_begun():
    began, go = [], threading.Event()

    def trial(index):
        began.append(index)
        if index == 1:
            go.wait()
        return {}

    with ThreadPoolExecutor(1) as threads:
        ended = outcomes(trial, range(9), threads)
        assert next(ended) == (0, {})
        ended.close()
        go.set()
    assert began in ([0], [0, 1])


def test_a_method_that_ends_the_process_fails_its_scene_alone():
    def trial(index):
        if index == 0:
            sys.exit("enough")
        return {}

    (_, failure), second = outcomes(trial, range(2))
    assert failure.error == "SystemExit: enough"
    assert second == (1, {})


def test_a_command_writes_what_was_found_and_fails_at_the_end(tmp_path, monkeypatch):
    def fake(study, index, methods, own):
        if index == 1:
            raise RuntimeError("lost")
        return {"scene": index, "methods": {name: {"points": [1000, 4000], "views": [0, 1]} for name in methods}}

    def run(out, scenes, **more):
        options = StudyOptions(scenes=scenes, out=tmp_path / out, **{"views": 2, "model": "paper"} | more)
        command.run_study("pyramid", options)

    monkeypatch.setitem(studies(), "pyramid", Entry("toy:ToyStudy", "", 3, 2))
    monkeypatch.setattr(command, "run_scene", fake)
    with pytest.raises(
        InputError,
        match=r"^1 of 3 scenes failed.*first scene 1 \(RuntimeError: lost\).*\.failed in .*/some have the reasons",
    ):
        run("some", "3")
    assert "points" in (tmp_path / "some" / "results.csv").read_text()
    monkeypatch.setattr(command, "run_scene", lambda study, index, **_: fake(study, 1, (), {}))
    with pytest.raises(InputError, match=r"^2 of 2 scenes failed"):
        run("all", "2")
    assert not (tmp_path / "all" / "results.csv").exists()
    monkeypatch.setattr(command, "run_scene", lambda study, index, **settings: fake(study, index + 1, **settings))
    run("range", "7:9")
    assert sorted(file.name for file in (tmp_path / "range").glob("scene_*")) == ["scene_0007.json", "scene_0008.json"]
    for wrong in ("0", "3:3", "9:7", "-2", "all"):
        with pytest.raises(InputError, match=f"--scenes {wrong} names no scenes"):
            run("wrong", wrong)
    with pytest.raises(InputError, match=r"belongs to another study; it differs in study\.capacity"):
        run("some", "3", capacity=77)
    monkeypatch.setattr(command, "run_scene", lambda study, index, **settings: fake(study, index + 4, **settings))
    run("joined", "3", join=[tmp_path / "some"])
    scenes = [json.loads((tmp_path / "joined" / f"scene_000{index}.json").read_text())["record"] for index in range(3)]
    assert [record["scene"] for record in scenes] == [0, 5, 2]
    with pytest.raises(InputError, match=r"--join .*/nowhere holds no records of this study"):
        run("joined", "2", join=[tmp_path / "some", tmp_path / "nowhere"])
    with pytest.raises(InputError, match=r"--workers 2 and --cluster tcp://here:1 exclude each other"):
        run("wrong", "2", workers=2, cluster="tcp://here:1")


def test_settings_of_the_command_replace_those_of_the_study(tmp_path, monkeypatch):
    planned = {}

    def fake(study, index, methods, own):
        planned[index] = study, study.planner("farthest", study.scene(index))
        return {"scene": index, "methods": {name: {"points": [1000, 4000], "views": [0, 1]} for name in methods}}

    def run(**settings):
        planned.clear()
        out = tmp_path / str(len(list(tmp_path.iterdir())))
        command.run_study("pyramid", StudyOptions(out=out, **settings))
        study, planner = planned[0]
        sampler = planner.sampler
        sizes = planner.search.candidates.count, sampler.num_samples, sampler.grid.resolution, planner.capacity
        return sizes, type(sampler.model).__name__, study.views

    monkeypatch.setitem(studies(), "pyramid", Entry("toy:ToyStudy", "", 3, 4))
    monkeypatch.setattr(command, "run_scene", fake)
    assert run(settings="paper") == ((120, 16, 100, 8192), "GeometricSPSR", 4)
    assert run(settings="paper", samples=3, model="screened", views=2) == ((120, 3, 100, 8192), "ScreenedSPSR", 2)
    single = {"candidates": 9, "samples": 3, "grid": 20, "capacity": 77}
    assert run(model="screened", **single)[0] == (9, 3, 20, 77)
    assert run(quick=True, model="screened", scenes="6", **single)[0] == (9, 3, 20, 77)
    assert sorted(planned) == [*range(6)]
    run(quick=True, model="screened")
    assert sorted(planned) == [*range(ToyStudy.quick_scenes)]
