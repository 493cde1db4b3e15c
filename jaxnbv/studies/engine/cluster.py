"""Executor that runs the scenes of a study on the workers of a Dask cluster."""

import concurrent.futures
import contextlib
import functools
import importlib
import itertools
import logging
import pickle
import sys
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Executor, Future
from typing import Any

from jaxnbv.checks import InputError, require
from jaxnbv.compiled import keep_compiled
from jaxnbv.errors import optional
from jaxnbv.storage.folders import differences, num_threads, versions

# Seconds to wait until a scheduler answers.
_TIMEOUT = 5


class Cluster(Executor):
    """Executor that runs calls on the workers of a Dask scheduler, one call at a time on each.

    - `address`: address of the scheduler, such as "tcp://HOST:8786".

    The constructor blocks until there is a worker. If a worker dies, Dask runs its call again on a different worker. By
    default, Dask gives up once four workers have died with one call. The future of this call then raises
    `BrokenExecutor`.

    **Raises:** `ValueError` if Dask is not installed or no scheduler answers. The constructor and the futures also
    raise `ValueError` in these cases:

    - the scheduler is gone;
    - a worker is set to run several calls at a time, or cannot import the function;
    - a worker's software or number of threads differs from that of this process;
    - a worker's device differs from that of the first worker.
    """

    def __init__(self, address: str):
        distributed = optional("distributed")
        self.address = address
        # Silence Dask's tracebacks of a lost connection, because this class raises an error that reports the loss.
        logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
        try:
            self._client = distributed.Client(address, timeout=_TIMEOUT, set_as_default=False)
        # If a server that is not a Dask scheduler listens at the address, any error may occur.
        except Exception as error:
            raise InputError(
                f"no Dask scheduler answers at {address} ({error}): start one with `dask scheduler`, and give the "
                "address that it shows, such as tcp://HOST:8786"
            ) from error
        lost = f"the Dask scheduler at {address} is gone"
        self._lost = f"{lost}: start it, then the same command again. Scenes that have a record are kept"
        self._pickled: tuple[Any, Any] = None, None
        self._count = itertools.count()
        self._running: set[Future] = set()
        pools = optional("threadpoolctl").threadpool_info()
        threads = [pool["num_threads"] for pool in pools if pool["user_api"] == "blas"]
        # Dask gives its workers one thread for linear algebra. Give them as many as this process has, at most NPROC.
        self._blas_threads = min([*threads, num_threads()])
        self._versions = versions()
        del self._versions["device"]
        try:
            if not self._client.scheduler_info()["workers"]:
                print(f"waiting for a worker of {address}", file=sys.stderr, flush=True)
            self._versions["device"] = self.submit(versions).result()["device"]
        except BaseException:
            self.shutdown(cancel_futures=True)
            raise

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future:
        """Run a call on a worker, and return its future. Consecutive calls of a function send it only once."""
        require(self._client.status == "running", self._lost)
        if function is not self._pickled[0]:
            # Pickle the function here, so that a worker compares versions before it imports the function's modules.
            content = optional("cloudpickle").dumps(function)
            self._pickled = function, self._client.submit(bytes, content, pure=False)
        task = self._client.submit(
            # A lambda is pickled as code, so the scheduler needs no jaxnbv. A worker without jaxnbv can report that.
            lambda *values: importlib.import_module("jaxnbv.studies.engine.cluster")._call(*values),
            self._pickled[1],
            self._versions,
            self._blas_threads,
            args,
            kwargs,
            # Run calls in order. Without a priority, Dask may reorder calls that arrive within a tenth of a second.
            priority=-next(self._count),
            pure=False,
        )
        answer: Future = Future()
        self._running.add(answer)
        answer.add_done_callback(self._running.discard)
        answer.add_done_callback(lambda answer: task.cancel() if answer.cancelled() else None)
        task.add_done_callback(lambda task: self._settle(task, answer))
        return answer

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Wait until all calls are done, then disconnect from the cluster, which keeps running.

        - `wait`: False disconnects at once.
        - `cancel_futures`: True disconnects at once and drops the calls that are not done.
        """
        if wait and not cancel_futures:
            concurrent.futures.wait(tuple(self._running))
        self._client.close()

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.shutdown(cancel_futures=kind is not None)

    def _settle(self, task: Any, answer: Future) -> None:
        """Set the result or error of a Dask task on the future that `submit` returned for the task."""
        if not answer.set_running_or_notify_cancel():
            return
        if task.status == "cancelled":
            answer.set_exception(InputError(self._lost))
            return
        try:
            answer.set_result(task.result())
        except optional("distributed").KilledWorker as error:
            answer.set_exception(BrokenExecutor(str(error)))
        except ImportError as error:
            problem = f"a worker of {self.address} cannot import what it runs ({error})"
            remedy = "install the same packages there, and name folders of your own modules in PYTHONPATH"
            answer.set_exception(InputError(f"{problem}: {remedy}"))
        except BaseException as error:
            answer.set_exception(error)
        # Release the result. Otherwise Dask would compute it again if the worker that holds it dies.
        task.release()


def _call(
    content: bytes, client_versions: dict[str, Any], blas_threads: int, args: tuple[Any, ...], kwargs: dict[str, Any]
) -> Any:
    """Call a pickled function on this worker, and return its result.

    - `content`: the pickled function.
    - `client_versions`: software, threads and (except in the first call) device that this worker must have.
    - `blas_threads`: number of threads for linear algebra.

    **Raises:** `ValueError` if the worker differs from the client or runs several calls at a time; `ImportError` if
    the function cannot be unpickled.
    """
    worker = optional("distributed").get_worker()
    require(
        worker.state.nthreads == 1,
        f"the worker {worker.address} runs {worker.state.nthreads} calls at a time: start it with --nthreads 1",
    )
    worker_versions = _prepare()
    changes = differences({name: worker_versions[name] for name in client_versions}, client_versions)
    require(
        not changes,
        f"the worker {worker.address} is unlike this process ({'; '.join(changes)}): install the same versions, and "
        "set NPROC, the number of threads, to the same number for both",
    )
    try:
        function = pickle.loads(content)
    # A user's module may raise anything on import.
    except Exception as error:
        raise ImportError(f"{type(error).__name__}: {error}") from error
    # Results of linear algebra depend on the number of threads in their last bits, so all workers use the same number.
    optional("threadpoolctl").threadpool_limits(blas_threads, user_api="blas")
    return function(*args, **kwargs)


@functools.cache
def _prepare() -> dict[str, Any]:
    """Enable the cache of compiled programs, as commands do, and return `versions` of this process."""
    with contextlib.suppress(InputError):
        keep_compiled()
    return versions()
