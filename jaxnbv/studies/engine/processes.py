"""Executor that runs the scenes of a study in processes on this machine."""

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
# Environment variables from which XLA, linear algebra libraries and process pools read their number of threads.
_THREADS = ("NPROC", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "LOKY_MAX_CPU_COUNT")


class Processes(Executor):
    """Executor that runs calls in `workers` processes on this machine.

    The processes share the machine's cores evenly. They end when this process ends. If a process dies during a call,
    for example from lack of memory, the call runs again in a new process. If the new process dies too, the future
    raises `BrokenExecutor`. If an error ends a `with` block, running calls are killed.
    """

    def __init__(self, workers: int):
        self._environment = dict.fromkeys(_THREADS, str(max(loky.cpu_count() // workers, 1)))
        self._threads = ThreadPoolExecutor(workers)
        # Each process has its own pool, because an error of a larger pool would not tell which call's process died.
        self._pools = [self._pool() for _ in range(workers)]
        self._free: queue.SimpleQueue[int] = queue.SimpleQueue()
        for number in range(workers):
            self._free.put(number)
        self._lock, self._is_closed = threading.Lock(), False

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future:
        """Pickle a call by cloudpickle, run it in one of the processes, and return its future."""
        return self._threads.submit(self._call, function, args, kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Wait until all calls are done, then end the processes.

        - `wait`: False returns at once. The processes then stay until this process ends.
        - `cancel_futures`: True kills running calls and cancels the calls that have not started.
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
            # The process died because `shutdown` killed it.
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
    """Start a thread that ends this process once its `parent` (process id) ends or is killed."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
