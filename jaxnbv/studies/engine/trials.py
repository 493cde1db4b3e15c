"""How the trials of a study are run: one after the other, or several at a time in processes of their own."""

import os
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from typing import NamedTuple, TypeAlias

import loky
from loky.process_executor import TerminatedWorkerError

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


def cores_of(workers: int) -> int:
    """How many cores share the sums of one trial."""
    return max(loky.cpu_count() // workers, 1)


def outcomes(trial: Trial, indices: Sequence[int], workers: int = 1) -> Outcomes:
    """Each trial's outcome once, in the order in which they end: in this process, or of several workers in as many
    processes, which share the machine's cores evenly.

    A trial whose process dies, for want of memory say, is begun once more in a new one.
    """
    if workers > 1:
        yield from _in_processes(trial, indices, workers)
        return
    for index in indices:
        yield index, _attempt(trial, index)


def _in_processes(trial: Trial, indices: Sequence[int], workers: int) -> Outcomes:
    waiting, tries = deque(indices), dict.fromkeys(indices, 0)
    # A pool each: when a process dies it is known which trial died with it.
    free = [_pool(workers) for _ in range(min(workers, len(indices)))]
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
                    free.append(_pool(workers))
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


def _pool(workers: int) -> loky.ProcessPoolExecutor:
    # What XLA, the libraries of linear algebra and our own pools of processes ask for how many threads to start.
    names = ("NPROC", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "LOKY_MAX_CPU_COUNT")
    environment = dict.fromkeys(names, str(cores_of(workers)))
    return loky.ProcessPoolExecutor(1, env=environment, initializer=_end_with, initargs=(os.getpid(),))


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
