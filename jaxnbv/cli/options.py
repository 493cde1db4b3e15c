"""What the commands' options mean."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated, NamedTuple

import typer

from jaxnbv.datasets import Framing
from jaxnbv.model_name import ModelName


class Task(StrEnum):
    """What the views are for."""

    CROSS_ENTROPY = "cross-entropy"
    ENTROPY = "entropy"
    MIXED = "mixed"
    COVERAGE = "coverage"
    PARTS = "parts"
    HEAT = "heat"


class SearchName(StrEnum):
    """How the next view is found."""

    DISCRETE = "discrete"
    HALVING = "halving"
    GRADIENT_2DOF = "gradient-2dof"
    GRADIENT_6DOF = "gradient-6dof"
    HYBRID = "hybrid"
    FARTHEST = "farthest"
    RANDOM = "random"
    UNCERTAINTY = "uncertainty"


class Device(StrEnum):
    """Where the computation runs."""

    AUTO = "auto"
    CPU = "cpu"
    GPU = "gpu"


TaskOption = Annotated[
    Task,
    typer.Option(
        help="What the views are for: the object's class, by expected cross-entropy, by expected reduction of "
        "entropy, or by cross-entropy until the entropy falls to 0.75; its shape (coverage); its parts; or the coldest "
        "point while it is heated at one place."
    ),
]
SearchOption = Annotated[
    SearchName,
    typer.Option(
        help="How the next view is found: discrete is the expected value of the task over 120 candidates (heat: 100); "
        "halving drops the worse half again and again while samples are added; "
        "gradient-2dof climbs it by gradient over the sphere, gradient-6dof over positions and rotations (up to 0.3 "
        "nearer or farther, the object's centre in view), hybrid over the sphere from the best candidates; "
        "farthest, random and uncertainty are the paper's baselines over the candidates."
    ),
]
ViewsOption = Annotated[int, typer.Option(help="Views in all, the first one included.")]
SeedOption = Annotated[
    int, typer.Option(min=0, max=2**63 - 1, help="Seed of the sensor's noise and of the posterior samples.")
]
OutOption = Annotated[Path | None, typer.Option(help="Output folder.", show_default="runs/NAME-SEARCH[-paper]")]
FirstOption = Annotated[
    str, typer.Option(help="Position of the first camera, x,y,z in scene units; it looks at the origin.")
]
DEFAULT_FIRST = "0.8,0.9,2.2"
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
        help="By what surfaces are imagined: screened knows that the object lies in its box and that space which was "
        "seen through is empty; paper is the published model, which knows the scanned normals alone."
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


class EpisodeOptions(NamedTuple):
    """What every command that runs one episode takes."""

    search: SearchName
    model: ModelName
    views: int
    seed: int
    out: Path | None
    noise: float
    quick: bool
    report: bool
