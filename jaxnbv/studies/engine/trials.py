"""How the trials of a study are run: one after the other in this process, or by an executor."""

import functools
import traceback
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, wait
from typing import NamedTuple, TypeAlias

from jaxnbv.studies.engine.measures import Record


class Failure(NamedTuple):
    """What is kept of a trial that failed: the error in a line, and where it came from."""

    error: str
    traceback: str


# One scene with all methods, by its index.
Trial: TypeAlias = Callable[[int], Record]
Outcome: TypeAlias = Record | Failure
Outcomes: TypeAlias = Generator[tuple[int, Outcome], None, None]


def outcomes(trial: Trial, indices: Sequence[int], executor: Executor | None = None) -> Outcomes:
    """Each trial's outcome once, in the order in which they end.

    - `executor`: of `concurrent.futures`; by default this process runs the trials, one after the other.

    A `BrokenExecutor` from the executor says that it gave a trial up, because its process died: a `Failure`. Any other
    error of the executor itself is raised. Trials that have not begun when the generator is closed are cancelled.
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
    # A method of the user's may end the process.
    except (Exception, SystemExit) as error:
        return Failure(f"{type(error).__name__}: {error}", traceback.format_exc())
