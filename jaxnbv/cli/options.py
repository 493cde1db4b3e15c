"""What `jaxnbv demo` and `jaxnbv run` are both asked, declared once."""

import functools
from collections.abc import Callable, Iterable
from functools import partial
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, TypeAlias, get_type_hints

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

# An option in each group of the help.
asking = partial(typer.Option, rich_help_panel="What to find out")
seeing = partial(typer.Option, rich_help_panel="Sensor")
imagining = partial(typer.Option, rich_help_panel="What is imagined")
finding = partial(typer.Option, rich_help_panel="How views are found")
running = partial(typer.Option, rich_help_panel="The run")


def listed(choices: Iterable[tuple[str, str]]) -> str:
    return "; ".join(f"{name}: {about}" for name, about in choices) + "."


class Asked(NamedTuple):
    """What a command that plays an episode is asked."""

    task: Annotated[Task, asking(metavar="TASK", help=listed((n, e.about) for n, e in TASKS.items()))] = "coverage"
    views: Annotated[int, asking(metavar="N", help="Views in all, the first one included.")] = 5
    until: Annotated[
        list[str] | None,
        asking(
            metavar="RULE=N",
            help="End once a rule holds; can be given several times. " + listed(STOPS.items()) + " Or never.",
            show_default="never; demo of a class: sure=0.95, of parts: found=60",
        ),
    ] = None
    first: Annotated[
        Position | None,
        seeing(
            metavar="X Y Z",
            help="Where the first camera stands, in scene units; it looks at the origin.",
            show_default="from 0.8 0.9 2.2, as far as the others; demo: where the answer hides",
        ),
    ] = None
    noise: Annotated[float, seeing(metavar="X", help="Standard deviation of points and normals.")] = 0.01
    model: Annotated[Model, imagining(metavar="MODEL", help=listed(MODELS.items()))] = "screened"
    known: Annotated[
        str | None,
        imagining(
            metavar="BANK",
            help=f"Shapes known before: a folder of upright meshes, or one of {', '.join(BANKS)}; or none.",
            show_default="none; demo, but for --model paper: others of the kind",
        ),
    ] = None
    search: Annotated[Search, finding(metavar="SEARCH", help=listed(SEARCHES.items()))] = "discrete"
    seed: Annotated[
        int, running(metavar="N", min=0, max=2**63 - 1, help="Seed of the sensor's noise and of the samples.")
    ] = 0
    out: Annotated[
        Path | None, running(metavar="DIR", help="Output folder.", show_default="runs/NAME-TASK-SEARCH[-MODEL]-seedN")
    ] = None
    quick: Annotated[bool, running("--quick", help="Small settings, for a first look; not the paper's.")] = False
    report: Annotated[bool, running("--report/--no-report", help="Write report.html.")] = True


def with_options(**defaults: Any) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """A command whose argument `asked` becomes the options of `Asked`, with other defaults."""

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(command)
        def called(**given: Any) -> None:
            command(Asked(**{name: given.pop(name) for name in Asked._fields}), **given)

        usual = Asked(**defaults)._asdict()
        hints = get_type_hints(Asked, include_extras=True)
        common = [
            Parameter(name, Parameter.KEYWORD_ONLY, default=usual[name], annotation=hints[name]) for name in hints
        ]
        _, *own = signature(command).parameters.values()
        taken = [*common, *(one.replace(kind=Parameter.KEYWORD_ONLY) for one in own)]
        called.__signature__ = Signature(taken)  # type: ignore[attr-defined]
        called.__annotations__ = {one.name: one.annotation for one in taken}
        return called

    return decorate
