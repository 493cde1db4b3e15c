"""Options that `jaxnbv demo` and `jaxnbv run` share."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeVar

from jaxnbv.cli.options import Position, asking, finding, imagining, listed, one_of, running, seeing
from jaxnbv.cli.registry import BANKS, MODELS, SEARCHES, STOPS
from jaxnbv.cli.tasks import TASKS
from jaxnbv.cli.tasks.base import Task

T = TypeVar("T")

TaskOption = Annotated[
    str,
    asking(parser=one_of(TASKS), metavar="TASK", help=listed((name, task.about) for name, task in TASKS.items())),
]
SearchOption = Annotated[str, finding(parser=one_of(SEARCHES), metavar="SEARCH", help=listed(SEARCHES.items()))]
SeedOption = Annotated[
    int, running(metavar="N", min=0, max=2**63 - 1, help="Seed of the sensor's noise and of the samples.")
]
KnownOption = Annotated[
    str | None,
    imagining(
        metavar="BANK",
        help=f"Known shapes: a folder of upright meshes, one of {', '.join(BANKS)}, or none. Not with --model paper.",
        show_default="none; for demo the bank of the object's kind; none with --model paper",
    ),
]


def by_task(of: Callable[[type[Task]], T]) -> dict[T, str]:
    """Group tasks by the value of a function. Returns their names, joined by "/", keyed by the value."""
    names: dict[T, list[str]] = {}
    for name, task in TASKS.items():
        names.setdefault(of(task), []).append(name)
    return {value: "/".join(tasks) for value, tasks in names.items()}


_ENOUGH = [f"{' '.join(until)} for {names}" for until, names in by_task(lambda task: task.until).items() if until]


@dataclass(frozen=True, kw_only=True)
class EpisodeOptions:
    """Options of a command that simulates an episode."""

    task: TaskOption
    views: Annotated[int, asking(metavar="N", help="Number of views, including the first.")] = 5
    until: Annotated[
        list[str] | None,
        asking(
            metavar="RULE=N",
            help="End when a rule holds. Can be repeated. "
            + listed((name, stop.about) for name, stop in STOPS.items())
            + " Give never for no rule.",
            show_default=f"never; demo: {', '.join(_ENOUGH)}",
        ),
    ] = None
    first: Annotated[
        Position | None,
        seeing(
            metavar="X Y Z",
            help="Position of the first camera, in scene units. The camera looks at the origin.",
            show_default="in direction 0.8 0.9 2.2, at the candidates' distance; demo: a view that hides the answer",
        ),
    ] = None
    noise: Annotated[float, seeing(metavar="X", help="Standard deviation of points and normals.")] = 0.01
    model: Annotated[str, imagining(parser=one_of(MODELS), metavar="MODEL", help=listed(MODELS.items()))] = "screened"
    known: KnownOption = None
    search: SearchOption
    seed: SeedOption = 0
    out: Annotated[
        Path | None, running(metavar="DIR", help="Output folder.", show_default="runs/NAME-TASK-SEARCH[-MODEL]-seedN")
    ] = None
    quick: Annotated[bool, running("--quick", help="Small and fast settings for a first try, not the paper's.")] = False
    report: Annotated[bool, running("--report/--no-report", help="Write report.html.")] = True
