"""Makes commands from dataclasses, whose fields are the arguments and options of the command."""

import dataclasses
import inspect
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any, TypeAlias, TypeVar, get_args, get_type_hints

import typer
from typer.core import TyperCommand
from typer.models import ArgumentInfo

from jaxnbv.errors import suggestion

Position: TypeAlias = tuple[float, float, float]
T = TypeVar("T")

# Each of these functions makes options of one group in the help.
task_option = partial(typer.Option, rich_help_panel="Task")
sensor_option = partial(typer.Option, rich_help_panel="Sensor")
sampler_option = partial(typer.Option, rich_help_panel="Imagined surfaces")
search_option = partial(typer.Option, rich_help_panel="Search")
run_option = partial(typer.Option, rich_help_panel="Run")
planner_option = partial(typer.Option, rich_help_panel="Planner")


def help_sentence(choices: Iterable[tuple[str, str]]) -> str:
    """Join names and their meanings into one sentence, "name: meaning; ...", for the help."""
    return "; ".join(f"{name}: {about}" for name, about in choices) + "."


def one_of(choices: Mapping[str, str], metavar: str, about: str = "") -> dict[str, Any]:
    """Return arguments for `typer.Option`, so that the option accepts only the names in `choices`.

    - `choices`: meanings for the help, keyed by name. The error for an unknown name suggests a similar one.
    - `about`: sentence that precedes the meanings in the help.
    """

    def parse(text: str) -> str:
        if text not in choices:
            raise typer.BadParameter(f"{text!r} is not one of {', '.join(choices)}.{suggestion(text, choices)}")
        return text

    return {"parser": parse, "metavar": metavar, "help": f"{about} {help_sentence(choices.items())}".lstrip()}


def command(options: type[T], more: Mapping[str, Any] = {}) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Decorator: make a typer command from a function whose first argument is a dataclass of options.

    - `options`: the dataclass. Its fields become options of the command.
    - `more`: annotations of further options, keyed by name. The function gets their values as keyword arguments, None
      if the user gives no value. The user must give a value for a `typer.Argument`.
    """

    def decorate(function: Callable[..., None]) -> Callable[..., None]:
        def call(**values: Any) -> None:
            further = {name: values.pop(name) for name in more}
            function(options(**values), **further)

        hints, empty = get_type_hints(options, include_extras=True) | dict(more), inspect.Parameter.empty
        fields = {one.name: one.default for one in dataclasses.fields(options)}  # type: ignore[arg-type]
        defaults = {name: empty if default is dataclasses.MISSING else default for name, default in fields.items()}
        for name, hint in more.items():
            defaults[name] = empty if isinstance(get_args(hint)[-1], ArgumentInfo) else None
        parameters = [
            inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=hints[name])
            for name, default in defaults.items()
        ]
        call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        call.__name__, call.__doc__ = function.__name__, function.__doc__
        return call

    return decorate


class Command(TyperCommand):
    """A command that reads `--option A B` as `--option A --option B` if the option's metavar ends in dots.

    A user can then give such an option a file pattern, which the shell expands to several words.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the words as click does, after repeating flags (see the class). Return the words left over."""
        repeated = {flag for one in self.params if str(one.metavar).endswith("...") for flag in one.opts}
        words: list[str] = []
        flag = None
        for word in args:
            if word.startswith("-"):
                flag = word if word in repeated else None
            elif flag and words[-1] != flag:
                words.append(flag)
            words.append(word)
        return super().parse_args(ctx, words)
