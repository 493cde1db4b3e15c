"""What the commands' options mean."""

import inspect
from collections.abc import Callable, Mapping
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from jaxnbv.cli.asked import DEFAULT_FIRST, Device
from jaxnbv.cli.registry import BANKS, MODELS, SEARCHES, STOPS, STUDY_MODELS, TASKS
from jaxnbv.studies.scenes import Framing

# The registries are the enumerations.
Task = StrEnum("Task", {name.replace("-", "_").upper(): name for name in TASKS})  # type: ignore[misc]
ModelName = StrEnum("ModelName", {name.upper(): name for name in MODELS})  # type: ignore[misc]
StudyModel = StrEnum("StudyModel", {name.upper(): name for name in STUDY_MODELS})  # type: ignore[misc]
SearchName = StrEnum("SearchName", {name.replace("-", "_").upper(): name for name in SEARCHES})  # type: ignore[misc]


REQUIRED = inspect.Parameter.empty


TaskOption = Annotated[
    Task, typer.Option(help="What the views are for. " + "; ".join(f"{n}: {e.about}" for n, e in TASKS.items()) + ".")
]
SearchOption = Annotated[
    SearchName,
    typer.Option(help="How the next view is found. " + "; ".join(f"{n}: {e.about}" for n, e in SEARCHES.items()) + "."),
]
ViewsOption = Annotated[int, typer.Option(help="Views in all, the first one included.")]
SeedOption = Annotated[
    int, typer.Option(min=0, max=2**63 - 1, help="Seed of the sensor's noise and of the posterior samples.")
]
UntilOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="RULE=N",
        help="End earlier, by the first of some rules that holds. "
        + "; ".join(f"{n}=N: {e.about}" for n, e in STOPS.items())
        + "; never: not earlier.",
        show_default="never; demo of a class: sure=0.95",
    ),
]
OutOption = Annotated[
    Path | None, typer.Option(help="Output folder.", show_default="runs/NAME-TASK-SEARCH[-MODEL]-seedN")
]
OverwriteOption = Annotated[
    bool, typer.Option("--overwrite", help="Begin anew: an episode that the output folder holds is removed.")
]
FirstOption = Annotated[
    str | None,
    typer.Option(
        help="Position of the first camera, x,y,z in scene units; it looks at the origin.",
        show_default=f"from {DEFAULT_FIRST}, as far as the others",
    ),
]
NetworkOption = Annotated[
    Path | None,
    typer.Option(
        help="A network, .pth or .safetensors: a classifier for the tasks that are about the class, "
        "which need one; for parts a part segmenter, in place of the one that ships."
    ),
]
CategoryOption = Annotated[
    str | None,
    typer.Option(
        help="What the object is, for parts: one of ShapeNet-part's categories, such as chair. Upright along y, "
        "facing x."
    ),
]
SourceOption = Annotated[
    str | None,
    typer.Option(
        help="Where the object is heated, for heat: x,y,z of a point on it, in scene units.",
        show_default="the middle of the first view",
    ),
]
NoiseOption = Annotated[float, typer.Option(help="Standard deviation of the sensor's noise on points and normals.")]
ModelOption = Annotated[
    ModelName,
    typer.Option(
        help="By what surfaces are imagined. " + "; ".join(f"{n}: {about}" for n, about in MODELS.items()) + "."
    ),
]
StudyModelOption = Annotated[
    StudyModel,
    typer.Option(
        help="By what surfaces are imagined. " + "; ".join(f"{n}: {about}" for n, about in STUDY_MODELS.items()) + "."
    ),
]
KnownOption = Annotated[
    str | None,
    typer.Option(
        metavar="BANK",
        help="Shapes that what was seen is compared with, beside the model: upright ones of a folder of meshes, or "
        f"{', '.join(BANKS)}, which ship; none: the model alone.",
        show_default="none; demo --model screened: other objects of the kind",
    ),
]
PaperOption = Annotated[
    bool,
    typer.Option(
        "--paper",
        help="The paper's close-up: 30 degrees from 2.5 (parts: 2, heat: 3); a view shows a patch of the object.",
    ),
]
FovOption = Annotated[
    float | None,
    typer.Option(
        min=1.0, max=170.0, help="Field of view in degrees.", show_default="30, or what fits the object from --radius"
    ),
]
RadiusOption = Annotated[
    float | None,
    typer.Option(
        help="Distance of the cameras from the object's centre, in scene units.",
        show_default="the object fits the view",
    ),
]
RaysOption = Annotated[
    int | None,
    typer.Option(min=4, max=1024, help="Rays along a side of the image.", show_default="50; parts: 64; --quick: 24"),
]
SamplesOption = Annotated[
    int | None, typer.Option(min=1, help="Surfaces that are imagined for each view.", show_default="16; --quick: 4")
]
CandidatesOption = Annotated[
    int | None,
    typer.Option(min=1, help="Poses among which a view is chosen.", show_default="120; heat: 100; --quick: 40"),
]
LengthscaleOption = Annotated[
    float | None,
    typer.Option(
        help="Lengthscale of the imagined surfaces' detail, a share of 2 pi scene units; longer is smoother.",
        show_default="0.01; --model paper: 0.005",
    ),
]
QuickOption = Annotated[
    bool, typer.Option("--quick", help="Small settings, for a first look in under a minute; not the paper's.")
]
ReportOption = Annotated[bool, typer.Option("--report/--no-report", help="Write report.html and the figures.")]
DeviceOption = Annotated[Device, typer.Option(help="Where to compute; auto takes a GPU if JAX sees one.")]
FramingOption = Annotated[
    Framing,
    typer.Option(
        help="How large the object stands: its longest side 2.5, a view shows a patch; or 1.25, and it nearly fits."
    ),
]


def command(run: Callable[..., None], about: str, options: Mapping[str, tuple[Any, Any]]) -> Callable[..., None]:
    """A function with these options, as Typer reads it, that hands them on to `run`.

    - `options`: annotation and default by name; the default is `REQUIRED` for an argument without one.
    """

    def called(**given: Any) -> None:
        run(**given)

    called.__doc__ = about
    called.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [
            inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
            for name, (annotation, default) in options.items()
        ]
    )
    return called
