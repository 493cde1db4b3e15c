"""`jaxnbv study NAME`: runs studies of the paper's claims, and the studies of users."""

import dataclasses
from typing import Any

import typer

from jaxnbv.cli.options import Command, command
from jaxnbv.cli.study_options import StudyOptions
from jaxnbv.studies.registry import Entry, studies

study = typer.Typer(
    help="""Measure a claim of the paper on many scenes.

    All methods have the same scenes, first views and noise. A study writes a record of each scene, tables, a chart and
    pictures. To continue an interrupted study, repeat its command.
    """,
    epilog="`jaxnbv study NAME --help` lists the options of a study. `jaxnbv report` makes one page of all studies.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    subcommand_metavar="NAME [OPTIONS]",
)


def _add(name: str, entry: Entry) -> None:
    """Add the command of a study to `jaxnbv study`."""
    common = {field.name for field in dataclasses.fields(StudyOptions)}
    own_options = {option: hint for option, hint in entry.options.items() if option not in common}

    @command(StudyOptions, own_options)
    def run(options: StudyOptions, **settings: Any) -> None:
        from jaxnbv.checks import check_device

        check_device()
        from jaxnbv.cli.run_study import run_study

        run_study(name, options, **settings)

    default_text = f"The default is {entry.scenes} scenes with {entry.views} views each."
    question = entry.question.partition("?")[0]
    study.command(
        name,
        cls=Command,
        help=f"{entry.question}\n\n{default_text}",
        short_help=f"{question}?",
        rich_help_panel="Studies",
    )(run)


for _name, _entry in studies().items():
    _add(_name, _entry)
