"""What `jaxnbv demo` and `jaxnbv run` are both asked, declared once."""

import dataclasses
import inspect
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, TypeAlias, TypeVar, get_type_hints

import typer

from jaxnbv.cli.registry import BANKS, MODELS, SEARCHES, STOPS, TASKS

# One of the registry's names, which type checkers do not read.
if TYPE_CHECKING:
    Task: TypeAlias = str
    Search: TypeAlias = str
    Model: TypeAlias = str
else:
    Task, Search, Model = (Literal[tuple(names)] for names in (TASKS, SEARCHES, MODELS))

Position = tuple[float, float, float]
T = TypeVar("T")

# An option in each group of the help.
asking = partial(typer.Option, rich_help_panel="What to find out")
seeing = partial(typer.Option, rich_help_panel="Sensor")
imagining = partial(typer.Option, rich_help_panel="What is imagined")
finding = partial(typer.Option, rich_help_panel="How views are found")
running = partial(typer.Option, rich_help_panel="The run")


def listed(choices: Iterable[tuple[str, str]]) -> str:
    return "; ".join(f"{name}: {about}" for name, about in choices) + "."


TaskOption = Annotated[Task, asking(metavar="TASK", help=listed((n, e.about) for n, e in TASKS.items()))]
ViewsOption = Annotated[int, asking(metavar="N", help="Views in all, the first one included.")]
UntilOption = Annotated[
    list[str] | None,
    asking(
        metavar="RULE=N",
        help="End once a rule holds; can be given several times. " + listed(STOPS.items()) + " Or never.",
        show_default="never; demo of a class: sure=0.95, of parts: found=60",
    ),
]
FirstOption = Annotated[
    Position | None,
    seeing(
        metavar="X Y Z",
        help="Where the first camera stands, in scene units; it looks at the origin.",
        show_default="from 0.8 0.9 2.2, as far as the others; demo: where the answer hides",
    ),
]
NoiseOption = Annotated[float, seeing(metavar="X", help="Standard deviation of points and normals.")]
ModelOption = Annotated[Model, imagining(metavar="MODEL", help=listed(MODELS.items()))]
KnownOption = Annotated[
    str | None,
    imagining(
        metavar="BANK",
        help=f"Shapes known before: a folder of upright meshes, or one of {', '.join(BANKS)}; or none.",
        show_default="none; demo, but for --model paper: others of the kind",
    ),
]
SearchOption = Annotated[Search, finding(metavar="SEARCH", help=listed(SEARCHES.items()))]
SeedOption = Annotated[
    int, running(metavar="N", min=0, max=2**63 - 1, help="Seed of the sensor's noise and of the samples.")
]
OutOption = Annotated[
    Path | None, running(metavar="DIR", help="Output folder.", show_default="runs/NAME-TASK-SEARCH[-MODEL]-seedN")
]
QuickOption = Annotated[bool, running("--quick", help="Small settings, for a first look; not the paper's.")]
ReportOption = Annotated[bool, running("--report/--no-report", help="Write report.html.")]


class Asked(NamedTuple):
    """What a command that plays an episode is asked."""

    task: str
    views: int
    until: list[str] | None
    first: Position | None
    noise: float
    model: str
    known: str | None
    search: str
    seed: int
    out: Path | None
    quick: bool
    report: bool


def command(options: type[T], more: Mapping[str, Any] = {}) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Decorator: a command for typer of a function that takes a dataclass of options.

    - `more`: annotations of further options by name, passed by keyword; None where they are not given.
    """

    def decorate(function: Callable[..., None]) -> Callable[..., None]:
        def call(**values: Any) -> None:
            further = {name: values.pop(name) for name in more}
            function(options(**values), **further)

        hints, fields = get_type_hints(options, include_extras=True), dataclasses.fields(options)  # type: ignore[arg-type]
        parameters = [
            _parameter(one.name, hints[one.name], _EMPTY if one.default is dataclasses.MISSING else one.default)
            for one in fields
        ]
        parameters += [_parameter(name, hint, None) for name, hint in more.items()]
        call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        call.__name__, call.__doc__ = function.__name__, function.__doc__
        return call

    return decorate


_EMPTY = inspect.Parameter.empty


def _parameter(name: str, annotation: Any, default: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
