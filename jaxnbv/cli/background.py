"""Calls in background threads. A process that ends does not wait for them."""

import os
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, NoReturn

_NAME = "jaxnbv-background"


def in_background(function: Callable[..., Any], *arguments: Any, **settings: Any) -> "Future[Any]":
    """Call a function in a new thread, and return a future of the result.

    The arguments are freed when the call ends.
    """
    future: Future[Any] = Future()

    def call() -> None:
        try:
            future.set_result(function(*arguments, **settings))
        except BaseException as error:
            future.set_exception(error)

    # A process that ends waits for the threads of an executor, but not for daemon threads.
    threading.Thread(target=call, name=_NAME, daemon=True).start()
    return future


def is_working() -> bool:
    """Return whether a call that `in_background` started is still running."""
    return any(thread.name == _NAME for thread in threading.enumerate())


def end_process(code: int) -> NoReturn:
    """End the process at once with this exit code.

    A normal exit crashes if a thread still runs compiled code.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
