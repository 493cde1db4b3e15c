"""`jaxnbv study ...`: the runs behind the paper's tables and figures, a command for each study of the registry."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from jaxnbv.cli import actions
from jaxnbv.cli.asked import Device
from jaxnbv.cli.options import REQUIRED, DeviceOption, StudyModel, StudyModelOption, command
from jaxnbv.studies.registry import STUDIES, Entry
from jaxnbv.studies.scenes import Framing

study = typer.Typer(
    help="Measure the paper's claims on many scenes.", no_args_is_help=True, rich_markup_mode="markdown"
)

ScenesOption = Annotated[
    str, typer.Option(metavar="N|A:B", help="Scenes of the test split: the first N, or from A up to but without B.")
]
ViewsOption = Annotated[int, typer.Option(min=2, help="Views in all, the first one included.")]
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
QuickOption = Annotated[
    bool, typer.Option("--quick", help="Small settings and few scenes: minutes, and not the full study.")
]
FolderOption = Annotated[
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
# Of single studies, by the names of their settings.
OPTIONS = {
    "meshes": Annotated[
        Path | None, typer.Option(help="A folder of meshes to scan.", show_default="procedural objects")
    ],
    "classifier": Annotated[
        Path | None,
        typer.Option(help="A network's checkpoint: .safetensors, .pth or .pt.", show_default="the one that ships"),
    ],
    "folder": Annotated[Path, typer.Argument(help="The recording.", show_default=False)],
    "box": Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(
            metavar="LOW HIGH",
            help="What is to be seen: two corners of a box, six numbers in the recording's units.",
            show_default="about nearly all that was seen",
        ),
    ],
    "up": Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            metavar="X Y Z",
            help="The direction that is upward, which becomes z of the box.",
            show_default="as recorded",
        ),
    ],
    "framing": Annotated[
        Framing | None,
        typer.Option(
            help="How large the object stands: a view shows a patch of it, or nearly all.", show_default="both"
        ),
    ],
}


@study.callback()
def _studies() -> None:
    """Measure the paper's claims on many scenes, with the same scenes, first views and noise for all methods."""


def _command(name: str, entry: Entry) -> Callable[..., None]:
    """The command of a study; its options are those of all studies and its own."""

    def run(device: Device, **given: Any) -> None:
        actions.prepare(device)
        actions.study(name, entry, device=device, **given)

    shared = {
        "scenes": (ScenesOption, str(entry.scenes)),
        "views": (ViewsOption, entry.views),
        "methods": (MethodsOption, None),
        "own": (OwnOption, None),
        "model": (StudyModelOption, StudyModel(entry.model)),
        "out": (FolderOption, None),
        "quick": (QuickOption, False),
        "workers": (WorkersOption, 1),
        "scheduler": (SchedulerOption, None),
        "device": (DeviceOption, Device.AUTO),
    }
    options = shared | {option: (OPTIONS[option], REQUIRED if option == "folder" else None) for option in entry.options}
    about = (
        f"{entry.question}\n\nWrites a record a scene, tables as text and CSV, figures and pictures. Interrupted, it "
        f"continues with the next scene.\n\n{entry.settings}"
    )
    return command(run, about, options)


for _name, _entry in STUDIES.items():
    study.command(_name)(_command(_name, _entry))
