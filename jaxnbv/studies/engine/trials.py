"""Where the trials of a study are run: here, in processes of this machine, or on a Dask cluster."""

import functools
import os
import pickle
import sys
import threading
import time
import traceback
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from types import ModuleType
from typing import Any, NamedTuple, TypeAlias

import loky
from loky.process_executor import TerminatedWorkerError
from tqdm import tqdm

from jaxnbv.checks import InputError, require
from jaxnbv.errors import optional
from jaxnbv.storage.folders import differences, software
from jaxnbv.studies.engine.measures import Record

_TRIES = 2


class Failure(NamedTuple):
    """What is kept of a trial that failed: the error in a line, and where it came from."""

    error: str
    traceback: str


# One scene with all methods, by its index.
Trial: TypeAlias = Callable[[int], Record]
Outcome: TypeAlias = Record | Failure
Outcomes: TypeAlias = Generator[tuple[int, Outcome], None, None]


class Runner(ABC):
    """Where trials are run."""

    @abstractmethod
    def outcomes(self, trial: Trial, indices: Sequence[int]) -> Outcomes:
        """Each trial's outcome once, in the order in which they end."""

    @property
    def cores(self) -> int:
        """How many share the sums of one trial."""
        return loky.cpu_count()


class Here(Runner):
    """In this process, one after the other."""

    def outcomes(self, trial: Trial, indices: Sequence[int]) -> Outcomes:
        for index in indices:
            yield index, _attempt(trial, index)


class Processes(Runner):
    """In several processes of this machine, which share its cores evenly.

    A trial whose process dies, for want of memory say, is begun once more in a new one.

    **Raises:** `ValueError` for less than one process.
    """

    def __init__(self, count: int):
        require(count >= 1, f"{count} processes cannot run trials: ask for at least one")
        self.count = count

    @property
    def cores(self) -> int:
        return max(loky.cpu_count() // self.count, 1)

    def outcomes(self, trial: Trial, indices: Sequence[int]) -> Outcomes:
        waiting, tries = deque(indices), dict.fromkeys(indices, 0)
        # A pool each: when a process dies it is known which trial died with it.
        free = [self._pool() for _ in range(min(self.count, len(indices)))]
        running: dict[Future, tuple[int, loky.ProcessPoolExecutor]] = {}
        try:
            while waiting or running:
                while waiting and free:
                    index, pool = waiting.popleft(), free.pop()
                    tries[index] += 1
                    running[pool.submit(_attempt, trial, index)] = index, pool
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    index, pool = running.pop(future)
                    try:
                        outcome: Outcome = future.result()
                    except TerminatedWorkerError as error:
                        pool.shutdown(kill_workers=True)
                        free.append(self._pool())
                        if tries[index] < _TRIES:
                            waiting.appendleft(index)
                            continue
                        outcome = Failure(f"its process died {_TRIES} times ({error})", str(error))
                    else:
                        free.append(pool)
                    yield index, outcome
        finally:
            for pool in (*free, *(pool for _, pool in running.values())):
                pool.shutdown(kill_workers=True)

    def _pool(self) -> loky.ProcessPoolExecutor:
        # What XLA, the libraries of linear algebra and our own pools of processes ask for how many threads to start.
        names = ("NPROC", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "LOKY_MAX_CPU_COUNT")
        environment = dict.fromkeys(names, str(self.cores))
        return loky.ProcessPoolExecutor(1, env=environment, initializer=_end_with, initargs=(os.getpid(),))


class Cluster(Runner):
    """On the workers of a Dask cluster that is running, as many trials at a time as they have threads.

    A trial whose worker dies is run by another one.

    - `address`: of the scheduler, such as tcp://10.0.0.1:8786.
    - `modules`: those that trials need and its machines do not have.

    **Raises:** `ValueError` without the package, or if no scheduler answers.
    """

    def __init__(self, address: str, modules: Sequence[ModuleType] = ()):
        distributed, cloudpickle = optional("distributed"), optional("cloudpickle")
        for module in modules:
            cloudpickle.register_pickle_by_value(module)
        try:
            self.client = distributed.Client(address, set_as_default=False)
        except (OSError, ValueError) as error:
            raise InputError(f"no scheduler of Dask answers at {address} ({error}): start one, or mend it") from error

    def outcomes(self, trial: Trial, indices: Sequence[int]) -> Outcomes:
        as_completed, dumps = optional("distributed").as_completed, optional("cloudpickle").dumps
        waiting, here, sent = deque(indices), software(), dumps(trial)
        running: dict[Any, int] = {}
        # With their results, which are lost if a worker dies that still holds them.
        ended = as_completed(with_results=True, raise_errors=False, loop=self.client.loop)
        try:
            while waiting or running:
                if not self.client.nthreads():
                    tqdm.write("the cluster has no workers yet: waiting for one", file=sys.stderr)
                    self.client.wait_for_workers(1)
                threads = sum(self.client.nthreads().values())
                # A trial holds the study, a network maybe: those that wait are not sent before their turn.
                while waiting and len(running) < 2 * max(threads, 1):
                    index = waiting.popleft()
                    future = self.client.submit(_attempt_alike, sent, index, here, pure=False)
                    running[future] = index
                    ended.add(future)
                future, outcome = next(ended)
                if future.cancelled():
                    raise InputError("the scheduler has dropped its work: start again, finished scenes are kept")
                if future.status == "error":
                    # Dask's own: of a trial's errors `_attempt` tells.
                    error = future.exception()
                    outcome = Failure(f"{type(error).__name__}: {error}", str(error))
                yield running.pop(future), outcome
        finally:
            self.client.cancel(list(running))


def _end_with(parent: int) -> None:
    """Ends this process when its parent is gone: one that is killed cannot end its processes."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _attempt(trial: Trial, index: int) -> Outcome:
    try:
        return trial(index)
    except Exception as error:
        return Failure(f"{type(error).__name__}: {error}", traceback.format_exc())


def _attempt_alike(trial: bytes, index: int, expected: dict[str, str]) -> Outcome:
    """A pickled trial on another machine, if its numbers will be those of this one."""
    differ = differences(software(), expected)
    if differ:
        error = f"the worker has other versions than the command: {'; '.join(differ)}"
        return Failure(error, error)
    return _attempt(lambda index: _unpickled(trial)(index), index)


@functools.lru_cache(1)
def _unpickled(trial: bytes) -> Trial:
    """Once a process: functions of modules that were sent along would be others each time, and compiled again."""
    return pickle.loads(trial)
