"""Functions that run trials (all methods on one scene), in this process or with an executor."""

import functools
import traceback
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, wait
from typing import NamedTuple, TypeAlias

from jaxnbv.studies.engine.measures import Record


class Failure(NamedTuple):
    """A failed trial: its error in one line, and its traceback."""

    error: str
    traceback: str


# Function from the index of a scene to the record of all methods.
Trial: TypeAlias = Callable[[int], Record]
Outcome: TypeAlias = Record | Failure
Outcomes: TypeAlias = Generator[tuple[int, Outcome], None, None]


def outcomes(trial: Trial, indices: Sequence[int], executor: Executor | None = None) -> Outcomes:
    """Run a trial on each scene in `indices`, and yield the index and the outcome when it ends.

    The outcome is the trial's record, or a `Failure` if the trial raises an error or its process dies (the executor
    raises `BrokenExecutor`). Other errors of the executor are raised. Closing the generator cancels the trials that
    have not started.
    """
    attempt = functools.partial(_attempt, trial)
    if executor is None:
        for index in indices:
            yield index, attempt(index)
        return
    running = {executor.submit(attempt, index): index for index in indices}
    try:
        while running:
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                index = running.pop(future)
                try:
                    outcome: Outcome = future.result()
                except BrokenExecutor as error:
                    outcome = Failure(str(error), str(error))
                yield index, outcome
    finally:
        for future in running:
            future.cancel()


def _attempt(trial: Trial, index: int) -> Outcome:
    try:
        return trial(index)
    # A user's method may call sys.exit.
    except (Exception, SystemExit) as error:
        return Failure(f"{type(error).__name__}: {error}", traceback.format_exc())
