"""`jaxnbv study NAME`: the runs behind the paper's tables and figures, and studies of the user's."""

from typing import Any

from jaxnbv.cli.options import command
from jaxnbv.cli.study_options import StudyOptions
from jaxnbv.studies.registry import Entry, studies

_OF_STUDIES = {name: hint for entry in studies().values() for name, hint in entry.options.items()}
"""Annotations of the studies' own options."""


@command(StudyOptions, _OF_STUDIES)
def study(options: StudyOptions, **of_studies: Any) -> None:
    from jaxnbv.checks import check_device

    check_device()
    from jaxnbv.cli.run_study import run_study

    run_study(options, **of_studies)


def _about(name: str, entry: Entry) -> str:
    details = ", ".join([f"{entry.scenes} scenes, {entry.views} views", *map(entry.flag, entry.options)])
    return f"**{name}** ({details}): {entry.question}"


study.__doc__ = "\n\n".join(
    [
        "Measure a claim of the paper on many scenes, with the same scenes, first views and noise for all methods.",
        "Writes a record of each scene, tables, a chart and pictures. An interrupted run continues where it stopped.",
        *(_about(name, entry) for name, entry in studies().items()),
    ]
)
