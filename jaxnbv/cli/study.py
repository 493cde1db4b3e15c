"""`jaxnbv study NAME`: the runs behind the paper's tables and figures."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias

import typer

from jaxnbv.cli import options
from jaxnbv.cli.registry import STUDY_MODELS
from jaxnbv.studies.registry import STUDIES, Entry, flag
from jaxnbv.studies.scenes import FirstView, Framing

if TYPE_CHECKING:
    StudyName: TypeAlias = str
    StudyModel: TypeAlias = str
else:
    StudyName, StudyModel = Literal[tuple(STUDIES)], Literal[tuple(STUDY_MODELS)]


def study(
    name: Annotated[
        StudyName, typer.Argument(metavar="NAME", help=f"Which: {', '.join(STUDIES)}.", show_default=False)
    ],
    folder: Annotated[Path | None, typer.Argument(help="A recording, for recorded.", show_default=False)] = None,
    scenes: Annotated[
        str | None,
        typer.Option(
            metavar="N|A:B",
            help="Scenes of the test split: the first N, or from A up to but without B.",
            show_default="as many as the study has by default",
        ),
    ] = None,
    views: Annotated[
        int | None, typer.Option(min=2, help="Views in all, the first one included.", show_default="the study's")
    ] = None,
    methods: Annotated[
        str | None, typer.Option(help="Which methods, separated by commas.", show_default="those of the table")
    ] = None,
    own: Annotated[
        list[str] | None,
        typer.Option(
            "--method",
            help="A method of your own in the same table, module:function. The function makes a Planner from the study "
            "and a scene of it; the module is looked for in the current folder too. Can be given several times.",
            show_default=False,
        ),
    ] = None,
    model: Annotated[
        StudyModel | None,
        typer.Option(
            metavar="MODEL",
            help="By what surfaces are imagined. " + options.listed(STUDY_MODELS.items()),
            show_default="known, where there are known shapes",
        ),
    ] = None,
    meshes: Annotated[
        Path | None, typer.Option(help="A folder of meshes to scan.", show_default="procedural objects")
    ] = None,
    classifier: Annotated[
        Path | None,
        typer.Option(help="A network's checkpoint: .safetensors, .pth or .pt.", show_default="the one that ships"),
    ] = None,
    framing: Annotated[
        Framing | None,
        typer.Option(
            help="How large a pyramid stands: a view shows a patch of it, or nearly all.", show_default="both"
        ),
    ] = None,
    first: Annotated[
        FirstView | None,
        typer.Option(
            help="Which first views: any, or of classes only those after which the classifier is wrong.",
            show_default="any",
        ),
    ] = None,
    box: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(
            metavar="LOW HIGH",
            help="What is to be seen of a recording: two corners of a box, six numbers in its units.",
            show_default="about nearly all that was seen",
        ),
    ] = None,
    up: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            metavar="X Y Z",
            help="The direction of a recording that is upward, which becomes z of the box.",
            show_default="as recorded",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        options.running(
            help="Output folder; the scenes already in it are not run again.",
            show_default="runs/study-NAME[-MODEL][-quick]",
        ),
    ] = None,
    quick: Annotated[
        bool, options.running("--quick", help="Small settings and few scenes: minutes, and not the full study.")
    ] = False,
    workers: Annotated[
        int, options.running(min=1, help="Scenes at a time, in as many processes, which share the cores.")
    ] = 1,
) -> None:
    asked = dict(locals())
    from jaxnbv.checks import check_device

    check_device()
    from jaxnbv.cli.run_study import run_study

    run_study(**asked)


def report(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="A folder of studies, or one in which such folders lie.")
    ],
    out: Annotated[Path | None, typer.Option(help="The page, an HTML file.", show_default="DIR/report.html")] = None,
) -> None:
    """Gather studies on one page: tables, figures, pictures, settings, versions and times. Nothing is run."""
    from jaxnbv.studies.engine.page import write_page

    typer.echo(f"{write_page(folder, out or folder / 'report.html')}")


def _about(name: str, entry: Entry) -> str:
    taken = ", ".join([f"{entry.scenes} scenes, {entry.views} views", *map(flag, entry.options)])
    return f"**{name}** ({taken}): {entry.question}"


study.__doc__ = "\n\n".join(
    [
        "Measure a claim of the paper on many scenes, with the same scenes, first views and noise for all methods.",
        "Writes a record a scene, tables, a chart and pictures. Interrupted, it continues with the next scene.",
        *(_about(name, entry) for name, entry in STUDIES.items()),
    ]
)
