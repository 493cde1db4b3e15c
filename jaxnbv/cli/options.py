"""How commands declare what they are asked: a dataclass a command, whose fields are its arguments and options."""

import dataclasses
import inspect
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any, TypeAlias, TypeVar, get_type_hints

import typer
from typer.core import TyperCommand

Position: TypeAlias = tuple[float, float, float]
T = TypeVar("T")

# An option in each group of the help.
asking = partial(typer.Option, rich_help_panel="What to find out")
seeing = partial(typer.Option, rich_help_panel="Sensor")
imagining = partial(typer.Option, rich_help_panel="What is imagined")
finding = partial(typer.Option, rich_help_panel="How views are found")
running = partial(typer.Option, rich_help_panel="The run")


def listed(choices: Iterable[tuple[str, str]]) -> str:
    """Names and what they mean, as one sentence of the help."""
    return "; ".join(f"{name}: {about}" for name, about in choices) + "."


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


class Command(TyperCommand):
    """A command that reads `--option A B` as `--option A --option B` where the option's metavar ends in dots: a shell
    writes out a pattern of files as several words."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """The words that are left, as in click."""
        several = {flag for one in self.params if str(one.metavar).endswith("...") for flag in one.opts}
        words: list[str] = []
        flag = None
        for word in args:
            if word.startswith("-"):
                flag = word if word in several else None
            elif flag and words[-1] != flag:
                words.append(flag)
            words.append(word)
        return super().parse_args(ctx, words)


_EMPTY = inspect.Parameter.empty


def _parameter(name: str, annotation: Any, default: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
