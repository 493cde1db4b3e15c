"""Work beside the main thread, which never keeps the process from ending."""

import os
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, NoReturn

_NAME = "jaxnbv-background"


def in_background(function: Callable[..., Any], *arguments: Any, **settings: Any) -> "Future[Any]":
    """The result to come of a call in a thread of its own. The thread lets go of the arguments when the call ends."""
    future: Future[Any] = Future()

    def call() -> None:
        try:
            future.set_result(function(*arguments, **settings))
        except BaseException as error:
            future.set_exception(error)

    # The threads of an executor are joined when the process ends; a daemon is not.
    threading.Thread(target=call, name=_NAME, daemon=True).start()
    return future


def is_working() -> bool:
    """Whether a call is still under way."""
    return any(thread.name == _NAME for thread in threading.enumerate())


def end_process(code: int) -> NoReturn:
    """End the process at once. Threads in compiled code abort a process that Python winds up beneath them."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
