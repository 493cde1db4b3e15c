"""Options that `jaxnbv demo` and `jaxnbv run` share."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeVar

from jaxnbv.cli.options import (
    Position,
    help_sentence,
    one_of,
    run_option,
    sampler_option,
    search_option,
    sensor_option,
    task_option,
)
from jaxnbv.cli.registry import BANKS, MODELS, SEARCHES, STOPS
from jaxnbv.cli.tasks import TASKS
from jaxnbv.cli.tasks.base import Task

T = TypeVar("T")

TaskOption = Annotated[str, task_option(**one_of({name: task.about for name, task in TASKS.items()}, "TASK"))]
SearchOption = Annotated[str, search_option(**one_of(SEARCHES, "SEARCH"))]
SeedOption = Annotated[
    int, run_option(metavar="N", min=0, max=2**63 - 1, help="Seed of the sensor's noise and of the samples.")
]
KnownOption = Annotated[
    str | None,
    sampler_option(
        metavar="BANK",
        help=f"Known shapes: a folder of upright meshes, one of {', '.join(BANKS)}, or none. Not with --model paper.",
        show_default="none; for demo the bank of the object's kind; none with --model paper",
    ),
]


def by_task(key: Callable[[type[Task]], T]) -> dict[T, str]:
    """Group the tasks by `key(task)`. Return the names of each group, joined by "/", keyed by this value."""
    names: dict[T, list[str]] = {}
    for name, task in TASKS.items():
        names.setdefault(key(task), []).append(name)
    return {value: "/".join(tasks) for value, tasks in names.items()}


_DEFAULT_RULES = [
    f"{' '.join(until)} for {names}" for until, names in by_task(lambda task: task.until).items() if until
]


@dataclass(frozen=True, kw_only=True)
class EpisodeOptions:
    task: TaskOption
    views: Annotated[int, task_option(metavar="N", help="Number of views, including the first.")] = 5
    until: Annotated[
        list[str] | None,
        task_option(
            metavar="RULE=N",
            help="End when a rule holds. Can be repeated. "
            + help_sentence((name, stop.about) for name, stop in STOPS.items())
            + " Give never for no rule.",
            show_default=f"never; demo: {', '.join(_DEFAULT_RULES)}",
        ),
    ] = None
    first: Annotated[
        Position | None,
        sensor_option(
            metavar="X Y Z",
            help="Position of the first camera, in scene units. The camera looks at the origin.",
            show_default="in direction 0.8 0.9 2.2, at the candidates' distance; demo: a view that hides the answer",
        ),
    ] = None
    noise: Annotated[float, sensor_option(metavar="X", help="Standard deviation of the noise.")] = 0.01
    model: Annotated[str, sampler_option(**one_of(MODELS, "MODEL"))] = "screened"
    known: KnownOption = None
    search: SearchOption
    seed: SeedOption = 0
    out: Annotated[
        Path | None,
        run_option(metavar="DIR", help="Output folder.", show_default="runs/NAME-TASK-SEARCH[-MODEL]-seedN"),
    ] = None
    quick: Annotated[bool, run_option("--quick", help="Small and fast settings for a first try, not the paper's.")] = (
        False
    )
    report: Annotated[bool, run_option("--report/--no-report", help="Write report.html.")] = True
