"""`jaxnbv identify RECORDING`: which of some known parts was recorded, and where it lies."""

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from jaxnbv.cli.options import asking, command, running, seeing
from jaxnbv.cli.registry import STOPS
from jaxnbv.errors import InputError
from jaxnbv.studies.entries import RECORDING

if TYPE_CHECKING:
    from jaxnbv.planning.session import Session
    from jaxnbv.surfaces.part_pose import ObjectPose

_NAMES_SAID, _BAR = 4, 24
_NO_FOLDER = (
    "is a file: identify needs depth images with the poses that they were taken from, since what rays pass through "
    "tells parts apart too. Give the folder of a recording (frames.json, 7-Scenes or TUM RGB-D); or scan a mesh by "
    "jaxnbv run MESH --task identify --parts FOLDER"
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class IdentifyOptions:
    recording: Annotated[
        Path, typer.Argument(metavar="RECORDING", help="A folder of depth images with poses, see RecordedFrames.")
    ]
    parts: Annotated[Path, asking(metavar="FOLDER", help="A folder with a mesh of each part that the object may be.")]
    parts_scale: Annotated[
        str,
        asking(metavar="UNIT", help="The parts' unit: mm, cm, m, in, ft where poses are in metres; else a number."),
    ] = "m"
    upright: Annotated[bool, asking("--upright", help="The object stands as its part's mesh does.")] = False
    parts_up: Annotated[str, asking(metavar="AXIS", help="The parts' axis that is upward, for --upright.")] = "y"
    views: Annotated[int, asking(metavar="N", min=1, help="How many frames are looked at, evenly spaced.")] = 8
    until: Annotated[
        list[str] | None,
        asking(
            metavar="RULE=N",
            help=f"End once a rule holds: identified={STOPS['identified'].about}, placed={STOPS['placed'].about}.",
            show_default="never",
        ),
    ] = None
    up: Annotated[
        str, seeing(metavar="AXIS", help="The recording's axis that is upward: x, y or z, or one of these with a -.")
    ] = "z"
    out: Annotated[
        Path | None, running(metavar="DIR", help="A folder for report.html and identity.json.", show_default="none")
    ] = None


@command(IdentifyOptions, {name: RECORDING[name] for name in ("box", "intrinsics", "depth_scale")})
def identify(options: IdentifyOptions, box: Any, intrinsics: Any, depth_scale: Any) -> None:
    """Say which part of a folder was recorded and where it lies: names with probabilities after each frame, then the
    pose in the recording's world.

    Nothing is trained. A part is a mesh at its true size; "none of these" is among the answers.
    """
    if options.recording.is_file():
        raise InputError(f"{options.recording} {_NO_FOLDER}")

    from jaxnbv.checks import check_device

    check_device()
    import numpy as np

    from jaxnbv.cli.play import rule
    from jaxnbv.cli.tasks.identification import as_unit, bank_of
    from jaxnbv.planning.planner import Planner
    from jaxnbv.planning.session import Session
    from jaxnbv.readers.recorded import RecordedFrames
    from jaxnbv.studies.recorded import bounds_of
    from jaxnbv.surfaces import FreeRotation, Upright
    from jaxnbv.surfaces.part_hypotheses import NONE

    frames = RecordedFrames(options.recording, None, intrinsics, depth_scale)
    corners = np.array(box or bounds_of(frames), np.float64).reshape(2, 3)
    bank = bank_of(options.parts, options.parts_scale, float(np.ptp(corners, axis=0).max()), options.parts_up)
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(options.views, len(frames))).round().astype(int)).tolist()
    planner = Planner.for_parts(bank, Upright() if options.upright else FreeRotation())
    planner = dataclasses.replace(planner, max_views=len(chosen))
    session = Session(frames.camera, corners, planner, options.up, until=rule(options.until or ()))
    for index in chosen:
        session.add(frames.depth(index), frames.matrices[index], frames.depth_scale)
        likely = list(session.identity.items())[:_NAMES_SAID]
        said = ", ".join(f"{name} {100 * probability:.0f} %" for name, probability in likely)
        typer.echo(f"frame {index:<5} {said}")
        if (reason := session.done()) is not None:
            typer.echo(f"enough      {reason}")
            break
    for name, probability in likely:
        typer.echo(f"{'█' * round(_BAR * probability):{_BAR}} {100 * probability:3.0f} %  {name}")
    # A named unit is one of a world in metres.
    unit = "m" if isinstance(as_unit(options.parts_scale), str) else session.frame.unit
    typer.echo("It is most likely none of these." if likely[0][0] == NONE else told(session.object_pose, unit))
    if options.out is not None:
        _write(options.out, options.recording.resolve().name, session)


def told(pose: "ObjectPose", unit: str) -> str:
    """Where a part lies and how sure that is, in lines; `unit`: of the world."""
    import numpy as np

    turn, shift = np.sqrt(np.diag(pose.covariance)).reshape(2, 3).max(axis=1).tolist()
    length = f"{1000.0 * shift:.2g} mm" if unit == "m" else f"{shift:.2g} {unit}"
    count = len(pose.alternatives)
    alike = f"{count} poses are equally right: the part is symmetric." if count > 1 else "No other pose is as right."
    return "\n".join(
        [
            f"{pose.name}: from its mesh, in the unit of the world, to the world",
            *("  ".join(f"{value:+.5f}" for value in row) for row in pose.matrix),
            f"Standard deviations along and about the axes known least: {length}, {np.degrees(turn):.2g} degrees.",
            alike,
        ]
    )


def _write(folder: Path, title: str, session: "Session") -> None:
    from jaxnbv.storage.files import write_text
    from jaxnbv.viz import write_report

    page, pose = write_report(session.episode, folder, title=title), session.object_pose
    held = {name: getattr(pose, name).tolist() for name in ("matrix", "covariance", "alternatives")}
    write_text(folder / "identity.json", json.dumps({"names": session.identity, "name": pose.name, **held}, indent=1))
    typer.echo(f"report      {page}")
