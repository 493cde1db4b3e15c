"""What the commands' options mean."""

from collections.abc import Iterable
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from jaxnbv.cli.registry import BANKS, DEFAULT_FIRST, MODELS, SEARCHES, STOPS, STUDY_MODELS, TASKS, Device
from jaxnbv.errors import install
from jaxnbv.studies.scenes import FirstView, Framing

# The registries are the enumerations.
Task = StrEnum("Task", {name.replace("-", "_").upper(): name for name in TASKS})  # type: ignore[misc]
ModelName = StrEnum("ModelName", {name.upper(): name for name in MODELS})  # type: ignore[misc]
StudyModel = StrEnum("StudyModel", {name.upper(): name for name in STUDY_MODELS})  # type: ignore[misc]
SearchName = StrEnum("SearchName", {name.replace("-", "_").upper(): name for name in SEARCHES})  # type: ignore[misc]

COVERAGE, CROSS_ENTROPY = Task("coverage"), Task("cross-entropy")
DISCRETE, HALVING, SCREENED = SearchName("discrete"), SearchName("halving"), ModelName("screened")

# An option in each group of the help.
asking = partial(typer.Option, rich_help_panel="What to find out")
_seeing = partial(typer.Option, rich_help_panel="Sensor")
_imagining = partial(typer.Option, rich_help_panel="What is imagined")
_finding = partial(typer.Option, rich_help_panel="How views are found")
running = partial(typer.Option, rich_help_panel="The run")


def _listed(choices: Iterable[tuple[str, str]]) -> str:
    return "; ".join(f"{name}: {about}" for name, about in choices) + "."


TaskOption = Annotated[
    Task,
    asking(metavar="TASK", help=_listed((n, e.about) for n, e in TASKS.items())),
]
SearchOption = Annotated[SearchName, _finding(metavar="SEARCH", help=_listed(SEARCHES.items()))]
ViewsOption = Annotated[int, asking(metavar="N", help="Views in all, the first one included.")]
SeedOption = Annotated[
    int,
    running(metavar="N", min=0, max=2**63 - 1, help="Seed of the sensor's noise and of the samples."),
]
UntilOption = Annotated[
    list[str] | None,
    asking(
        metavar="RULE=N",
        help="End once a rule holds; can be given several times. " + _listed(STOPS.items()) + " Or never.",
        show_default="never; demo of a class: sure=0.95, of parts: found=60",
    ),
]
OutOption = Annotated[
    Path | None,
    running(metavar="DIR", help="Output folder.", show_default="runs/NAME-TASK-SEARCH[-MODEL]-seedN"),
]
OverwriteOption = Annotated[
    bool,
    running("--overwrite", help="Begin anew: an episode that the output folder holds is removed."),
]
FirstOption = Annotated[
    str | None,
    _seeing(
        metavar="X,Y,Z",
        help="Position of the first camera, in scene units; it looks at the origin.",
        show_default=f"from {DEFAULT_FIRST}, as far as the others",
    ),
]
NetworkOption = Annotated[
    Path | None,
    asking(
        metavar="FILE",
        help="A classifier, .pth or .safetensors, which tasks about the class need; for parts a segmenter.",
    ),
]
CategoryOption = Annotated[
    str | None,
    asking(
        metavar="NAME",
        help="For parts: what the object is, one of ShapeNet-part's categories; upright along y, facing x.",
    ),
]
SourceOption = Annotated[
    str | None,
    asking(
        metavar="X,Y,Z",
        help="For heat: the point of the object that is heated, in scene units.",
        show_default="the middle of the first view",
    ),
]
NoiseOption = Annotated[float, _seeing(metavar="X", help="Standard deviation of points and normals.")]
ModelOption = Annotated[ModelName, _imagining(metavar="MODEL", help=_listed(MODELS.items()))]
StudyModelOption = Annotated[
    StudyModel | None,
    typer.Option(
        metavar="MODEL",
        help="By what surfaces are imagined. " + _listed(STUDY_MODELS.items()),
        show_default="known, where there are known shapes",
    ),
]
KnownOption = Annotated[
    str | None,
    _imagining(
        metavar="BANK",
        help=f"Shapes known before: a folder of upright meshes, or one of {', '.join(BANKS)}; or none.",
        show_default="none; demo, but for --model paper: others of the kind",
    ),
]
PaperOption = Annotated[
    bool,
    _seeing("--paper", help="The paper's close-up: 30 degrees from 2.5 (parts: 2, heat: 3)."),
]
FovOption = Annotated[
    float | None,
    _seeing(
        metavar="DEGREES",
        min=1.0,
        max=170.0,
        help="Field of view.",
        show_default="30, or what fits the object from --radius",
    ),
]
RadiusOption = Annotated[
    float | None,
    _seeing(
        metavar="X",
        help="Distance of the cameras from the object's centre, in scene units.",
        show_default="the object fits the view",
    ),
]
RaysOption = Annotated[
    int | None,
    _seeing(
        metavar="N", min=4, max=1024, help="Rays along a side of the image.", show_default="50; parts: 64; --quick: 24"
    ),
]
SamplesOption = Annotated[
    int | None,
    _imagining(metavar="N", min=1, help="Surfaces that are imagined for each view.", show_default="16; --quick: 4"),
]
CandidatesOption = Annotated[
    int | None,
    _finding(
        metavar="N", min=1, help="Poses among which a view is chosen.", show_default="120; heat: 100; --quick: 40"
    ),
]
LengthscaleOption = Annotated[
    float | None,
    _imagining(
        metavar="X",
        help="Lengthscale of their detail, a share of 2 pi scene units; longer is smoother.",
        show_default="0.01; --model paper: 0.005",
    ),
]
QuickOption = Annotated[bool, running("--quick", help="Small settings, for a first look; not the paper's.")]
ReportOption = Annotated[bool, running("--report/--no-report", help="Write report.html and the figures.")]
DeviceOption = Annotated[
    Device,
    running(metavar="DEVICE", help="Where to compute: cpu, gpu, or auto, a GPU if JAX sees one."),
]

ScenesOption = Annotated[
    str | None,
    typer.Option(
        metavar="N|A:B",
        help="Scenes of the test split: the first N, or from A up to but without B.",
        show_default="as many as the study has by default",
    ),
]
StudyViewsOption = Annotated[
    int | None, typer.Option(min=2, help="Views in all, the first one included.", show_default="the study's")
]
MethodsOption = Annotated[
    str | None, typer.Option(help="Which methods, separated by commas.", show_default="all of the table")
]
OwnOption = Annotated[
    list[str] | None,
    typer.Option(
        "--method",
        help="A method of your own in the same table, module:function. The function makes a Planner from the study and "
        "a scene of it; the module is looked for in the current folder too. Can be given several times.",
        show_default=False,
    ),
]
StudyQuickOption = Annotated[
    bool,
    running("--quick", help="Small settings and few scenes: minutes, and not the full study."),
]
StudyOutOption = Annotated[
    Path | None,
    running(
        "--out",
        help="Output folder; the scenes already in it are not run again.",
        show_default="runs/study-NAME[-MODEL][-quick]",
    ),
]
WorkersOption = Annotated[int, running(min=1, help="Scenes at a time, in as many processes, which share the cores.")]
SchedulerOption = Annotated[
    str | None,
    running(
        metavar="ADDRESS",
        help="Run the scenes on a Dask cluster: its scheduler, such as tcp://10.0.0.1:8786. "
        f"Needs `{install('cluster')}`, here and on its workers.",
        show_default=False,
    ),
]
MeshesOption = Annotated[
    Path | None, typer.Option(help="A folder of meshes to scan.", show_default="procedural objects")
]
CheckpointOption = Annotated[
    Path | None,
    typer.Option(
        "--classifier", help="A network's checkpoint: .safetensors, .pth or .pt.", show_default="the one that ships"
    ),
]
BoxOption = Annotated[
    tuple[float, float, float, float, float, float] | None,
    typer.Option(
        metavar="LOW HIGH",
        help="What is to be seen of a recording: two corners of a box, six numbers in its units.",
        show_default="about nearly all that was seen",
    ),
]
UpOption = Annotated[
    tuple[float, float, float] | None,
    typer.Option(
        metavar="X Y Z",
        help="The direction of a recording that is upward, which becomes z of the box.",
        show_default="as recorded",
    ),
]
StudyFramingOption = Annotated[
    Framing | None,
    typer.Option(
        "--framing", help="How large a pyramid stands: a view shows a patch of it, or nearly all.", show_default="both"
    ),
]
StudyFirstOption = Annotated[
    FirstView | None,
    typer.Option(
        "--first",
        help="Which first views: any, or of classes only those after which the classifier is wrong.",
        show_default="any",
    ),
]
