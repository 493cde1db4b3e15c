"""`jaxnbv identify RECORDING`: which of some known parts were recorded, and where they lie."""

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
    import numpy as np

    from jaxnbv.planning.session import Session
    from jaxnbv.readers.recorded import RecordedFrames
    from jaxnbv.surfaces.part_pose import ObjectPose

_NAMES_SAID, _BAR = 4, 24
# A frame of which fewer pixels than this fall into the box shows no object.
_FEWEST = 20
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
    several: Annotated[
        bool, asking("--several", help="There are several objects on a table, apart from one another.")
    ] = False
    masks: Annotated[
        Path | None,
        asking(
            metavar="FOLDER",
            help="Images that say which object each pixel shows: FRAME.png with a number a pixel, or FRAME.OBJECT.png, "
            "a mask for each object.",
            show_default="none",
        ),
    ] = None
    out: Annotated[
        Path | None,
        running(metavar="DIR", help="A folder for identity.json and a report of each object.", show_default="none"),
    ] = None


@command(IdentifyOptions, {name: RECORDING[name] for name in ("box", "intrinsics", "depth_scale")})
def identify(options: IdentifyOptions, box: Any, intrinsics: Any, depth_scale: Any) -> None:
    """Say which part of a folder was recorded and where it lies: names with probabilities after each frame, then the
    pose in the recording's world. With --several or --masks, this of each object.

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
    from jaxnbv.planning.sessions import Sessions
    from jaxnbv.readers.recorded import RecordedFrames
    from jaxnbv.readers.segmentation import Segmentation
    from jaxnbv.studies.recorded import bounds_of
    from jaxnbv.surfaces import FreeRotation, Upright

    frames = RecordedFrames(options.recording, None, intrinsics, depth_scale)
    corners = np.array(box or bounds_of(frames), np.float64).reshape(2, 3)
    bank = bank_of(options.parts, options.parts_scale, float(np.ptp(corners, axis=0).max()), options.parts_up)
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(options.views, len(frames))).round().astype(int)).tolist()
    planner = Planner.for_parts(bank, Upright() if options.upright else FreeRotation())
    planner = dataclasses.replace(planner, max_views=len(chosen))
    masks = None if options.masks is None else Segmentation(options.masks, frames.files)
    kind = Session if masks is None and not options.several else Sessions
    looked = kind(frames.camera, corners, planner, options.up, until=rule(options.until or ()))
    names: dict[int, str] = {} if masks is None else masks.names
    for index in chosen:
        labels = None if masks is None else masks.labels(index)
        if not _shows(frames, index, corners) or (masks is not None and labels is None):
            typer.echo(f"frame {index:<5} shows no object in the box")
            continue
        image = frames.depth(index), frames.matrices[index], frames.depth_scale
        if isinstance(looked, Sessions):
            looked.add(*image, labels=labels)
        else:
            looked.add(*image)
        for name, session in _objects(looked, names).items():
            likely = ", ".join(f"{part} {100 * share:.0f} %" for part, share in _likely(session))
            typer.echo(f"frame {index:<5} {f'{name}: ' if name else ''}{likely}")
        if (reason := looked.done()) is not None:
            typer.echo(f"enough      {reason}")
            break
    if not _objects(looked, names) or (isinstance(looked, Session) and not looked.views):
        raise InputError(
            f"none of the {len(chosen)} frames of {options.recording} shows an object in the box: give --box, or more "
            "--views"
        )
    # A named unit is one of a world in metres.
    unit = "m" if isinstance(as_unit(options.parts_scale), str) else None
    answers = {}
    for name, session in _objects(looked, names).items():
        answers[name or "object"] = _say(name, session, unit)
        if options.out is not None:
            _write(options.out / name, name or options.recording.resolve().name, session)
    if options.out is not None:
        from jaxnbv.storage.files import write_text

        write_text(options.out / "identity.json", json.dumps(answers, indent=1))


def _shows(frames: "RecordedFrames", index: int, corners: "np.ndarray") -> bool:
    """Whether a frame shows something of a box."""
    import numpy as np

    from jaxnbv.geometry.pose import Pose
    from jaxnbv.planning.images import Image

    image = Image.of(frames.depth(index), frames.matrices[index], frames.depth_scale, None)
    points = image.points(frames.camera, Pose.from_matrix(image.matrix))
    inside = (image.depth > 0) & np.all((points > corners[0]) & (points < corners[1]), axis=-1)
    return int(inside.sum()) >= _FEWEST


def _objects(looked: Any, names: dict[int, str]) -> "dict[str, Session]":
    """The session of each object by its name: "" for one alone."""
    several = getattr(looked, "objects", None)
    if several is None:
        return {"": looked}
    return {names.get(number, str(number)): session for number, session in several.items()}


def _likely(session: "Session") -> list[tuple[str, float]]:
    return list(session.identity.items())[:_NAMES_SAID]


def _say(name: str, session: "Session", unit: str | None) -> dict[str, Any]:
    """Print which part an object is and where it lies, and return it as JSON."""
    from jaxnbv.surfaces.part_hypotheses import NONE

    if name:
        typer.echo(f"\n{name}")
    for part, share in _likely(session):
        typer.echo(f"{'█' * round(_BAR * share):{_BAR}} {100 * share:3.0f} %  {part}")
    pose, is_none = session.object_pose, next(iter(session.identity)) == NONE
    typer.echo("It is most likely none of these." if is_none else told(pose, unit or session.frame.unit))
    held = {of: getattr(pose, of).tolist() for of in ("matrix", "covariance", "alternatives")}
    return {"names": session.identity, "name": NONE if is_none else pose.name, **held}


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
    from jaxnbv.viz import write_report

    typer.echo(f"report      {write_report(session.episode, folder, title=title)}")
