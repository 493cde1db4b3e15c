"""Trials of a study on a Dask cluster: a scheduler and two processes on this machine."""

import contextlib
import functools
import json
import os
import signal
import subprocess
import sys
import threading
from concurrent.futures import BrokenExecutor
from pathlib import Path

import pytest
from deadly import Stalling
from test_study import small, without_time
from test_trials import squares, wait_until

from jaxnbv.checks import InputError
from jaxnbv.errors import optional
from jaxnbv.studies.engine import cluster as module
from jaxnbv.studies.engine.cluster import Cluster
from jaxnbv.studies.engine.records import RecordFolder
from jaxnbv.studies.engine.run import run_scene
from jaxnbv.tasks.heat import _map

REASON = "Dask is not installed: it comes with jaxnbv[cluster]"
distributed = pytest.importorskip("distributed", reason=REASON)
threadpool_info = pytest.importorskip("threadpoolctl", reason=REASON).threadpool_info


def start_dask(*arguments, cwd):
    folder = str(Path(__file__).parent)
    paths = os.pathsep.join(filter(None, [folder, os.environ.get("PYTHONPATH")]))
    command = [sys.executable, "-m", "dask", *arguments, "--no-dashboard"]
    environment = os.environ | {"PYTHONPATH": paths, "OPENBLAS_NUM_THREADS": "2"}
    return subprocess.Popen(command, cwd=cwd, env=environment, stderr=subprocess.DEVNULL)


def blas_threads(pools):
    return {pool["num_threads"] for pool in pools if pool["user_api"] == "blas"}


@contextlib.contextmanager
def dask(folder, workers):
    """A scheduler with workers, which Dask restarts when they die: the scheduler's process and address."""
    scheduler = start_dask("scheduler", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", "here", cwd=folder)
    wait_until((folder / "here").exists)
    address = json.loads((folder / "here").read_text())["address"]
    options = ("--nworkers", f"{workers}", "--nthreads", "1", "--memory-limit", "0", "--death-timeout", "30")
    others = start_dask("worker", address, *options, cwd=folder)
    with distributed.Client(address, set_as_default=False) as client:
        client.wait_for_workers(workers, timeout=60)
    yield scheduler, address
    for process in (others, scheduler):
        process.terminate()
        process.wait()


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    """The address of a scheduler with two workers."""
    with dask(tmp_path_factory.mktemp("dask"), 2) as (_, address):
        yield address


@pytest.mark.slow
def test_the_scene_of_a_killed_worker_is_run_again_and_no_other(address, tmp_path):
    trial = Stalling(tmp_path)
    records = tmp_path / "records"

    def kill():
        wait_until(lambda: trial.beginnings(2) and len([*records.glob("scene_*.json")]) == 5)
        (begun,) = trial.beginnings(2)
        os.kill(int(begun.name.partition("-")[2]), signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    with Cluster(address) as workers:
        assert RecordFolder(records, {}, workers).collect(range(6), trial, progress=False) == squares(*range(6))
    killer.join()
    assert [len(trial.beginnings(index)) for index in range(6)] == [1, 1, 2, 1, 1, 1]


@pytest.mark.slow
def test_a_scene_that_kills_every_worker_is_given_up(address):
    with distributed.Client(address, set_as_default=False) as client:
        client.run_on_scheduler(lambda dask_scheduler: setattr(dask_scheduler, "allowed_failures", 0))
    with Cluster(address) as workers:
        with pytest.raises(BrokenExecutor, match="but all those workers died while running it"):
            workers.submit(lambda: os.kill(os.getpid(), signal.SIGKILL)).result()
        assert workers.submit(abs, -3).result() == 3


@pytest.mark.slow
def test_a_study_on_a_cluster_finds_what_it_finds_here(address, tmp_path):
    trial = functools.partial(run_scene, small(num_candidates=4, views=2))
    here = RecordFolder(tmp_path / "here", {}).collect(range(2), trial, progress=False)
    with Cluster(address) as workers:
        there = RecordFolder(tmp_path / "there", {}, workers).collect(range(2), trial, progress=False)
        # Linear algebra has as many threads as here, and a worker may start no processes.
        assert blas_threads(workers.submit(threadpool_info).result()) == {min(blas_threads(threadpool_info()))}
        assert workers.submit(_map, max, [1, -2], [0, 0], 2).result() == [1, 0]
    assert list(map(without_time, here)) == list(map(without_time, there))
    assert (tmp_path / "here" / "study.json").read_bytes() == (tmp_path / "there" / "study.json").read_bytes()


@pytest.mark.slow
def test_what_a_worker_cannot_import_is_named(address, monkeypatch, tmp_path):
    (tmp_path / "mine.py").write_text("def planner(study, scene):\n    pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    with Cluster(address) as workers, pytest.raises(InputError, match=r"\(.*No module named 'mine'\).*PYTHONPATH"):
        workers.submit(functools.partial(run_scene, own={"mine:planner": optional("mine").planner})).result()


@pytest.fixture
def threads():
    """A function that starts a cluster with one worker in this process."""
    clusters = []

    def start(count=1):
        clusters.append(distributed.LocalCluster(1, threads_per_worker=count, processes=False, dashboard_address=":0"))
        return clusters[-1]

    yield start
    for one in clusters:
        one.close()


def test_calls_are_made_and_errors_are_those_of_the_call(threads):
    with Cluster(threads().scheduler_address) as workers:
        assert [workers.submit(pow, index, exp=2).result() for index in range(4)] == [0, 1, 4, 9]
        with pytest.raises(ZeroDivisionError):
            workers.submit(divmod, 1, 0).result()
        last = workers.submit(abs, -3)
    assert last.result() == 3


def test_workers_that_differ_are_refused(threads, monkeypatch):
    monkeypatch.setattr(module, "_prepare", lambda: module.versions() | {"jax": "0.0.1", "cores": 77})
    with pytest.raises(
        InputError, match=r"worker \w+://.* is unlike this process \(jax: '0.0.1' there, .*cores: 77 there"
    ):
        Cluster(threads().scheduler_address)
    monkeypatch.undo()
    with pytest.raises(InputError, match=r"runs 2 calls at a time: start it with --nthreads 1"):
        Cluster(threads(2).scheduler_address)


@pytest.mark.slow
def test_a_scheduler_that_dies_is_named_and_records_are_kept(tmp_path):
    trial = Stalling(tmp_path)
    (records := tmp_path / "records").mkdir()

    def kill():
        wait_until(lambda: trial.beginnings(2) and (records / "scene_0000.json").exists())
        scheduler.kill()

    with dask(tmp_path, 1) as (scheduler, address), Cluster(address) as workers:
        killer = threading.Thread(target=kill)
        killer.start()
        with pytest.raises(InputError, match=r"the Dask scheduler at \S+ is gone: start it"):
            RecordFolder(records, {}, workers).collect((0, 2), trial, progress=False)
        killer.join()
    assert [path.name for path in records.glob("scene_*")] == ["scene_0000.json"]


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "127.0.0.1", "http://127.0.0.1:9"])
def test_an_address_without_a_scheduler_is_named(address, monkeypatch):
    monkeypatch.setattr(module, "_TIMEOUT", 0.2)
    with pytest.raises(InputError, match=f"no Dask scheduler answers at {address} .*start one with `dask scheduler`"):
        Cluster(address)


def test_the_extra_is_named_where_dask_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r'this needs distributed: pip install "\.\[cluster\]"'):
        Cluster("tcp://127.0.0.1:9")
