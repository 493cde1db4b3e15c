"""Where trials are run."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import dask
import distributed
import loky
import psutil
import pytest
from deadly import Trial
from test_study import small, without_time
from toy import ToyStudy

from jaxnbv.checks import InputError
from jaxnbv.cli.run_study import run_study
from jaxnbv.storage.folders import software
from jaxnbv.studies.engine.records import RecordFolder
from jaxnbv.studies.engine.trials import Cluster, Here, Processes
from jaxnbv.studies.registry import STUDIES, Entry


@pytest.fixture(scope="module")
def cluster():
    """A scheduler and two worker processes, which their nannies replace when they die.

    A worker holds one trial at a time, which is given up when it has killed a second one.
    """
    with (
        dask.config.set({f"distributed.scheduler.{name}": 1 for name in ("allowed-failures", "worker-saturation")}),
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as started,
    ):
        yield started


def squares(*indices):
    return [{"square": index * index} for index in indices]


def check_every_trial_is_in_the_result_once(folder, runner, killed):
    trial = Trial(folder)
    records = RecordFolder(folder / "records", {"views": 3}, runner)
    assert records.collect(range(6), trial, progress=False) == squares(0, 1, 2, 5)
    assert len(trial.beginnings(2)) >= 2
    failures = records.failures(range(6))
    assert list(failures) == [3, 4]
    assert failures[3] == "RuntimeError: the third never works"
    assert killed in failures[4]
    assert list(records.failures(range(4))) == [3]
    assert "in __call__" in (folder / "records" / "scene_0003.failed").read_text()
    # The next time those that failed are tried alone.
    asked = []
    again = records.collect(range(6), lambda index: asked.append(index) or {"square": index**2}, progress=False)
    assert again == squares(*range(6))
    assert records.failures(range(6)) == {}
    return trial


@pytest.mark.slow
def test_in_processes_no_trial_is_lost_though_some_die(tmp_path):
    trial = check_every_trial_is_in_the_result_once(tmp_path, Processes(2), "died 2 times")
    assert [len(trial.beginnings(index)) for index in range(6)] == [1, 1, 2, 1, 2, 1]


@pytest.mark.slow
def test_processes_end_when_the_command_is_killed(tmp_path):
    program = (
        "from pathlib import Path; from deadly import Endless; from jaxnbv.studies.engine.trials import Processes;"
        f"list(Processes(1).outcomes(Endless(Path({str(tmp_path)!r})), [0]))"
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
def test_on_a_cluster_no_trial_is_lost_though_workers_die(tmp_path, cluster):
    check_every_trial_is_in_the_result_once(tmp_path, Cluster(cluster.scheduler_address), "KilledWorker")


def test_workers_with_other_versions_are_not_used(tmp_path, cluster, monkeypatch):
    monkeypatch.setattr("jaxnbv.studies.engine.trials.software", lambda: software() | {"jax": "0.0.1"})
    records = RecordFolder(tmp_path, {}, Cluster(cluster.scheduler_address))
    assert records.collect(range(1), Trial(tmp_path), progress=False) == []
    assert "other versions than the command: jax: " in records.failures(range(1))[0]
    assert not Trial(tmp_path).beginnings(0)


@pytest.mark.slow
def test_a_study_in_processes_finds_what_it_finds_here(tmp_path):
    balls = small(num_candidates=4, views=2)
    here, processes = (
        RecordFolder(tmp_path / type(runner).__name__, {}, runner).collect(range(2), balls.run_scene, progress=False)
        for runner in (Here(), Processes(1))
    )
    assert list(map(without_time, here)) == list(map(without_time, processes))


def test_processes_share_the_cores():
    assert Processes(1).cores == loky.cpu_count()
    assert Processes(2).cores == max(loky.cpu_count() // 2, 1)
    assert Processes(1000).cores == 1
    pool = Processes(2)._pool()
    assert pool.submit(eval, "__import__('loky').cpu_count()").result() == Processes(2).cores
    pool.shutdown()


def test_where_trials_cannot_be_run_is_refused():
    with pytest.raises(InputError, match="0 processes"):
        Processes(0)
    with (
        dask.config.set({"distributed.comm.timeouts.connect": "1s"}),
        pytest.raises(InputError, match=r"no scheduler of Dask answers at tcp://127\.0\.0\.1:9"),
    ):
        Cluster("tcp://127.0.0.1:9")


def test_a_command_writes_what_was_found_and_fails_at_the_end(tmp_path, monkeypatch):
    def run_scene(self, index, methods, own):
        if index == 1:
            raise RuntimeError("lost")
        return {"scene": index, "methods": {name: {"points": [1000, 4000], "views": [0, 1]} for name in methods}}

    def run(out, scenes):
        none = dict.fromkeys(("methods", "own", "out", "scheduler"))
        settings = {"views": 2, "model": "paper", "quick": False, "workers": 1, "out": tmp_path / out}
        run_study("toy", **none | settings | {"scenes": scenes})

    monkeypatch.setitem(STUDIES, "toy", Entry("toy:ToyStudy", "", "", 3, 2))
    monkeypatch.setattr(ToyStudy, "run_scene", run_scene)
    with pytest.raises(
        InputError, match=r"^1 of 3 scenes failed.*first scene 1 \(RuntimeError: lost\).*/some has scene_\*\.failed"
    ):
        run("some", "3")
    assert "points" in (tmp_path / "some" / "results.csv").read_text()
    monkeypatch.setattr(ToyStudy, "run_scene", lambda self, index, **_: run_scene(self, 1, (), {}))
    with pytest.raises(InputError, match=r"^2 of 2 scenes failed"):
        run("all", "2")
    assert not (tmp_path / "all" / "results.csv").exists()
    monkeypatch.setattr(ToyStudy, "run_scene", lambda self, index, **given: run_scene(self, index + 1, **given))
    run("range", "7:9")
    assert sorted(file.name for file in (tmp_path / "range").glob("scene_*")) == ["scene_0007.json", "scene_0008.json"]
    for wrong in ("0", "3:3", "9:7", "-2", "all"):
        with pytest.raises(InputError, match=f"--scenes {wrong} names no scenes"):
            run("wrong", wrong)
    with pytest.raises(InputError, match="exclude each other"):
        run_study("toy", "2", 2, None, None, "paper", None, False, 2, "tcp://127.0.0.1:9")
    with pytest.raises(InputError, match="the study toy takes no --meshes: it is for truck"):
        run_study("toy", "2", 2, None, None, "paper", None, False, 1, None, meshes=tmp_path)
