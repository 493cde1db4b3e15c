"""What the commands' options mean."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from jaxnbv.cli.registry import BANKS, DEFAULT_FIRST, MODELS, SEARCHES, STOPS, STUDY_MODELS, TASKS, Device
from jaxnbv.studies.scenes import Framing

# The registries are the enumerations.
Task = StrEnum("Task", {name.replace("-", "_").upper(): name for name in TASKS})  # type: ignore[misc]
ModelName = StrEnum("ModelName", {name.upper(): name for name in MODELS})  # type: ignore[misc]
StudyModel = StrEnum("StudyModel", {name.upper(): name for name in STUDY_MODELS})  # type: ignore[misc]
SearchName = StrEnum("SearchName", {name.replace("-", "_").upper(): name for name in SEARCHES})  # type: ignore[misc]

COVERAGE, CROSS_ENTROPY = Task("coverage"), Task("cross-entropy")
DISCRETE, HALVING, SCREENED = SearchName("discrete"), SearchName("halving"), ModelName("screened")

TaskOption = Annotated[
    Task, typer.Option(help="What the views are for. " + "; ".join(f"{n}: {e.about}" for n, e in TASKS.items()) + ".")
]
SearchOption = Annotated[
    SearchName,
    typer.Option(
        help="How the next view is found. " + "; ".join(f"{n}: {about}" for n, about in SEARCHES.items()) + "."
    ),
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
        + "; ".join(f"{n}=N: {about}" for n, about in STOPS.items())
        + "; never: not earlier.",
        show_default="never; demo of a class: sure=0.95, of parts: found=60",
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
    StudyModel | None,
    typer.Option(
        help="By what surfaces are imagined. " + "; ".join(f"{n}: {about}" for n, about in STUDY_MODELS.items()) + ".",
        show_default="known, where there are known shapes",
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
    bool, typer.Option("--quick", help="Small settings and few scenes: minutes, and not the full study.")
]
StudyOutOption = Annotated[
    Path | None,
    typer.Option(
        "--out",
        help="Output folder; the scenes already in it are not run again.",
        show_default="runs/study-NAME[-MODEL][-quick]",
    ),
]
WorkersOption = Annotated[
    int, typer.Option(min=1, help="Scenes at a time, in as many processes, which share the cores.")
]
SchedulerOption = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Run the scenes on a Dask cluster: its scheduler, such as tcp://10.0.0.1:8786. "
        'Needs `pip install "jaxnbv[cluster]"` here and on its workers.',
        show_default=False,
    ),
]
MeshesOption = Annotated[
    Path | None, typer.Option(help="A folder of meshes to scan.", show_default="procedural objects")
]
CheckpointOption = Annotated[
    Path | None,
    typer.Option(
        "--classifier",
        help="A network's checkpoint: .safetensors, .pth or .pt.",
        show_default="the one that ships",
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
        "--framing",
        help="How large a pyramid stands: a view shows a patch of it, or nearly all.",
        show_default="both",
    ),
]
