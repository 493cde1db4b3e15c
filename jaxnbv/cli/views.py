"""`jaxnbv demo` and `jaxnbv run MESH`: one episode."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer

from jaxnbv.cli import actions
from jaxnbv.cli.asked import Device, EpisodeOptions, SensorOptions, SizeOptions
from jaxnbv.cli.options import (
    REQUIRED,
    CandidatesOption,
    CategoryOption,
    DeviceOption,
    FirstOption,
    FovOption,
    FramingOption,
    KnownOption,
    LengthscaleOption,
    ModelName,
    ModelOption,
    NetworkOption,
    NoiseOption,
    OutOption,
    OverwriteOption,
    PaperOption,
    QuickOption,
    RadiusOption,
    RaysOption,
    ReportOption,
    SamplesOption,
    SearchName,
    SearchOption,
    SeedOption,
    SourceOption,
    Task,
    TaskOption,
    UntilOption,
    ViewsOption,
    command,
)
from jaxnbv.studies.scenes import Framing

_T = TypeVar("_T")

MeshArgument = Annotated[
    Path, typer.Argument(metavar="MESH", help="Any mesh that trimesh reads: OBJ, PLY, STL, OFF, glTF, ...")
]
SceneOption = Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Which object: the number of a scene.")]
HidingFirstOption = Annotated[
    str | None,
    typer.Option(help="Position of the first camera, x,y,z.", show_default="one that hides the pattern"),
]
_EPISODE: dict[str, tuple[Any, Any]] = {
    "search": (SearchOption, SearchName("discrete")),
    "model": (ModelOption, ModelName("screened")),
    "known": (KnownOption, None),
    "views": (ViewsOption, 5),
    "until": (UntilOption, None),
    "seed": (SeedOption, 0),
    "out": (OutOption, None),
    "overwrite": (OverwriteOption, False),
    "noise": (NoiseOption, 0.01),
    "quick": (QuickOption, False),
    "report": (ReportOption, True),
    "device": (DeviceOption, Device.AUTO),
}


# No view depends on these.
_FREE = {"views", "until", "out", "overwrite", "report"}


def _options(device: Device, given: dict[str, Any]) -> tuple[EpisodeOptions, dict[str, Any]]:
    """What every episode takes, and what is left."""
    actions.prepare(device)
    asked = {name: str(value) if isinstance(value, Path) else value for name, value in given.items()}
    given["asked"] = {name: value for name, value in asked.items() if name not in _FREE}
    return _taken(EpisodeOptions, given), given


def _taken(kind: Callable[..., _T], given: dict[str, Any]) -> _T:
    """A named tuple of options, taken out of those that are given."""
    return kind(*(given.pop(name) for name in kind._fields))  # type: ignore[attr-defined]


def _demo(device: Device, **given: Any) -> None:
    options, own = _options(device, given)
    actions.demo(**own, options=options)


def _run(device: Device, **given: Any) -> None:
    options, own = _options(device, given)
    sensor, sizes = _taken(SensorOptions, own), _taken(SizeOptions, own)
    actions.run(**own, sensor=sensor, sizes=sizes, options=options)


demo = command(
    _demo,
    """Find out which pattern is pressed into the base of a pyramid: no file, no network.

    The first view does not show the pattern. The pyramid is small enough for a view to see nearly all of its near side;
    with --framing close-up a view shows a patch of it. With --task parts the object is a procedural one of thirteen
    categories, with --task heat one of four kinds that is heated at one place, and with --task coverage a laid tea mug,
    to be seen all round.
    """,
    {
        "task": (TaskOption, Task("cross-entropy")),
        "scene": (SceneOption, 0),
        "framing": (FramingOption, Framing.WHOLE),
        "first": (HidingFirstOption, None),
    }
    | _EPISODE,
)
run = command(
    _run,
    """Choose views of a mesh, scanned by a simulated depth camera.

    The mesh may be open, a soup of triangles or inconsistently wound. It is scaled and centred so that its longest side
    is 2.5 scene units; cameras stand as far from its centre as it takes to see all of it.
    """,
    {
        "mesh": (MeshArgument, REQUIRED),
        "task": (TaskOption, Task("coverage")),
        "network": (NetworkOption, None),
        "category": (CategoryOption, None),
        "source": (SourceOption, None),
        "first": (FirstOption, None),
        "paper": (PaperOption, False),
        "fov": (FovOption, None),
        "radius": (RadiusOption, None),
        "rays": (RaysOption, None),
        "samples": (SamplesOption, None),
        "candidates": (CandidatesOption, None),
        "lengthscale": (LengthscaleOption, None),
    }
    | _EPISODE,
)
