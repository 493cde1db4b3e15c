"""Processes on this machine that run the trials of a study."""

import os
import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from typing import Any

import loky
from loky.process_executor import TerminatedWorkerError

_TRIES = 2
# Read by XLA, the libraries of linear algebra and our own pools of processes.
_THREADS = ("NPROC", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "LOKY_MAX_CPU_COUNT")


class Processes(Executor):
    """Processes on this machine, which share its cores evenly and end with this one.

    - `workers`: number of processes.

    A call whose process dies, for want of memory say, is begun once more in a new one. If that dies too, its future
    raises `BrokenExecutor`. Leaving a `with` block by an error kills the calls that run.
    """

    def __init__(self, workers: int):
        self._environment = dict.fromkeys(_THREADS, str(max(loky.cpu_count() // workers, 1)))
        self._threads = ThreadPoolExecutor(workers)
        # One pool a process: the call that died with a process is the one that ran in its pool.
        self._pools = [self._pool() for _ in range(workers)]
        self._free: queue.SimpleQueue[int] = queue.SimpleQueue()
        for number in range(workers):
            self._free.put(number)
        self._lock, self._is_closed = threading.Lock(), False

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future:
        """The future of a call. Function and arguments are pickled by cloudpickle."""
        return self._threads.submit(self._call, function, args, kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes once no call is left.

        - `cancel_futures`: kill the calls that run, and cancel those that have not begun.
        """
        if cancel_futures:
            self._kill()
        self._threads.shutdown(wait, cancel_futures=cancel_futures)
        if wait:
            self._kill()

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.shutdown(cancel_futures=kind is not None)

    def _call(self, function: Callable[..., Any], args: tuple, kwargs: dict[str, Any]) -> Any:
        number = self._free.get()
        try:
            for _ in range(_TRIES):
                try:
                    return self._pools[number].submit(function, *args, **kwargs).result()
                except TerminatedWorkerError as error:
                    reason = error
                    self._replace(number)
            raise BrokenExecutor(f"its process died {_TRIES} times ({reason})")
        finally:
            self._free.put(number)

    def _replace(self, number: int) -> None:
        with self._lock:
            # Killed by `shutdown`.
            if self._is_closed:
                raise BrokenExecutor("the processes were shut down")
            self._pools[number].shutdown(kill_workers=True)
            self._pools[number] = self._pool()

    def _kill(self) -> None:
        with self._lock:
            self._is_closed = True
        for pool in self._pools:
            pool.shutdown(kill_workers=True)

    def _pool(self) -> loky.ProcessPoolExecutor:
        return loky.ProcessPoolExecutor(1, env=self._environment, initializer=_end_with, initargs=(os.getpid(),))


def _end_with(parent: int) -> None:
    """End this process when its parent is gone: one that is killed cannot end its processes."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
