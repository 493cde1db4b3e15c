"""`jaxnbv identify RECORDING`: finds names and poses of known parts in a recording."""

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import jaxnbv as nbv
from jaxnbv.cli.options import command, run_option, sensor_option, task_option
from jaxnbv.cli.registry import STOPS
from jaxnbv.errors import InputError
from jaxnbv.studies.entries import RECORDING

if TYPE_CHECKING:
    import numpy as np

    from jaxnbv.surfaces.part_pose import ObjectPose

_NUM_NAMES, _BAR_WIDTH = 4, 24
# A frame counts as showing no object if fewer than this many of its points are in the box.
_MIN_POINTS = 20
_NO_FOLDER = (
    "is a file: identify needs depth images with the poses of the camera, since the empty space along rays also tells "
    "parts apart. Give the folder of a recording (frames.json, 7-Scenes or TUM RGB-D), or scan a mesh with "
    "jaxnbv run MESH --task identify --parts FOLDER"
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class IdentifyOptions:
    recording: Annotated[
        Path, typer.Argument(metavar="RECORDING", help="Folder of depth images with poses, see RecordedFrames.")
    ]
    parts: Annotated[
        Path, task_option(metavar="FOLDER", help="Folder with a mesh of each part that the object may be.")
    ]
    parts_scale: Annotated[
        str,
        task_option(
            metavar="UNIT", help="Unit of the parts: mm, cm, m, in or ft if poses are in metres, else a number."
        ),
    ] = "m"
    upright: Annotated[bool, task_option("--upright", help="The object stands upright, like its mesh.")] = False
    parts_up: Annotated[str, task_option(metavar="AXIS", help="Upward axis of the parts, for --upright.")] = "y"
    views: Annotated[int, task_option(metavar="N", min=1, help="Number of frames to use, evenly spaced.")] = 8
    until: Annotated[
        list[str] | None,
        task_option(
            metavar="RULE=N",
            help=f"End when a rule holds: identified={STOPS['identified'].about}, placed={STOPS['placed'].about}.",
            show_default="never",
        ),
    ] = None
    up: Annotated[
        str, sensor_option(metavar="AXIS", help="Upward axis of the recording: x, y or z, or one of these with a -.")
    ] = "z"
    several: Annotated[
        bool, task_option("--several", help="Several objects stand apart from each other on a table.")
    ] = False
    masks: Annotated[
        Path | None,
        task_option(
            metavar="FOLDER",
            help="Folder of label images: FRAME.png with an object number in each pixel, or FRAME.OBJECT.png, a mask "
            "for each object.",
            show_default="none",
        ),
    ] = None
    out: Annotated[
        Path | None,
        run_option(
            metavar="DIR", help="Output folder for identity.json and a report of each object.", show_default="none"
        ),
    ] = None


@command(IdentifyOptions, {name: RECORDING[name] for name in ("box", "intrinsics", "depth_scale")})
def identify(options: IdentifyOptions, box: Any, intrinsics: Any, depth_scale: Any) -> None:
    """Find out which of the parts in a folder was recorded, and where it lies.

    Prints the parts' names with probabilities after each frame, then the pose in the recording's world. With --several
    or --masks it prints both for each object. Nothing is trained. A part is a mesh at its true size. The answer can
    be "none of these", which means that the object is not in the folder.
    """
    if options.recording.is_file():
        raise InputError(f"{options.recording} {_NO_FOLDER}")

    from jaxnbv.checks import check_device

    check_device()
    import numpy as np

    from jaxnbv.cli.play import stop_rule_of
    from jaxnbv.cli.tasks.identification import as_unit, bank_of
    from jaxnbv.readers.segmentation import Segmentation
    from jaxnbv.studies.shown_voxels import bounds_of

    frames = nbv.readers.RecordedFrames(options.recording, None, intrinsics, depth_scale)
    corners = np.array(box or bounds_of(frames), np.float64).reshape(2, 3)
    bank = bank_of(options.parts, options.parts_scale, float(np.ptp(corners, axis=0).max()), options.parts_up)
    indices = np.unique(np.linspace(0, len(frames) - 1, min(options.views, len(frames))).round().astype(int)).tolist()
    planner = nbv.Planner.for_parts(bank, nbv.surfaces.Upright() if options.upright else nbv.surfaces.FreeRotation())
    planner = dataclasses.replace(planner, max_views=len(indices))
    masks = None if options.masks is None else Segmentation(options.masks, frames.files)
    kind = nbv.Session if masks is None and not options.several else nbv.Sessions
    sessions = kind(frames.camera, corners, planner, options.up, until=stop_rule_of(options.until or ()))
    names: dict[int, str] = {} if masks is None else masks.names
    for index in indices:
        labels = None if masks is None else masks.labels(index)
        if not _shows(frames, index, corners) or (masks is not None and labels is None):
            typer.echo(f"frame {index:<5} shows no object in the box")
            continue
        image = frames.depth(index), frames.matrices[index], frames.depth_scale
        if isinstance(sessions, nbv.Sessions):
            sessions.add(*image, labels=labels)
        else:
            sessions.add(*image)
        for name, session in _objects(sessions, names).items():
            likely = ", ".join(f"{part} {100 * p:.0f} %" for part, p in _likely_names(session))
            typer.echo(f"frame {index:<5} {f'{name}: ' if name else ''}{likely}")
        if (reason := sessions.done()) is not None:
            typer.echo(f"enough      {reason}")
            break
    if not _objects(sessions, names) or (isinstance(sessions, nbv.Session) and not sessions.views):
        raise InputError(
            f"none of the {len(indices)} frames of {options.recording} shows an object in the box: give --box, or more "
            "--views"
        )
    # If the parts have a named unit, the world is in metres.
    unit = "m" if isinstance(as_unit(options.parts_scale), str) else None
    answers = {}
    for name, session in _objects(sessions, names).items():
        answers[name or "object"] = _print_answer(name, session, unit)
        if options.out is not None:
            title = name or options.recording.resolve().name
            typer.echo(f"report      {nbv.write_report(session.episode, options.out / name, title=title)}")
    if options.out is not None:
        from jaxnbv.storage.files import write_text

        write_text(options.out / "identity.json", json.dumps(answers, indent=1))


def _shows(frames: "nbv.readers.RecordedFrames", index: int, corners: "np.ndarray") -> bool:
    """Return whether frame `index` shows at least `_MIN_POINTS` points in the box.

    - `corners`: lowest and highest corner of the box, in world coordinates.
    """
    import numpy as np

    from jaxnbv.planning.images import Image

    image = Image.from_arrays(frames.depth(index), frames.matrices[index], frames.depth_scale, None)
    points = image.points(frames.camera, nbv.Pose.from_matrix(image.matrix))
    is_inside = (image.depth > 0) & np.all((points > corners[0]) & (points < corners[1]), axis=-1)
    return int(is_inside.sum()) >= _MIN_POINTS


def _objects(sessions: Any, names: dict[int, str]) -> "dict[str, nbv.Session]":
    """Return the session of each object, keyed by the object's name. A single `Session` has the key "".

    - `sessions`: a `Session`, or `Sessions` with numbered objects.
    - `names`: names of some objects, keyed by number. The number is the name of the other objects.
    """
    objects = getattr(sessions, "objects", None)
    if objects is None:
        return {"": sessions}
    return {names.get(number, str(number)): session for number, session in objects.items()}


def _likely_names(session: "nbv.Session") -> list[tuple[str, float]]:
    return list(session.identity.items())[:_NUM_NAMES]


def _print_answer(name: str, session: "nbv.Session", unit: str | None) -> dict[str, Any]:
    """Print which part an object is and where it lies, and return both for a JSON file.

    - `name`: name of the object, "" for a single object.
    - `unit`: the world's unit of length; None for that of the session's frame.
    """
    from jaxnbv.surfaces.part_hypotheses import NONE

    if name:
        typer.echo(f"\n{name}")
    for part, p in _likely_names(session):
        typer.echo(f"{'█' * round(_BAR_WIDTH * p):{_BAR_WIDTH}} {100 * p:3.0f} %  {part}")
    pose, is_none = session.object_pose, next(iter(session.identity)) == NONE
    typer.echo("It is most likely none of these." if is_none else object_pose_text(pose, unit or session.frame.unit))
    arrays = {field: getattr(pose, field).tolist() for field in ("matrix", "covariance", "alternatives")}
    return {"names": session.identity, "name": NONE if is_none else pose.name, **arrays}


def object_pose_text(pose: "ObjectPose", unit: str) -> str:
    """Return the pose of a part and its standard deviations as text. `unit`: the world's unit of length."""
    import numpy as np

    angle, shift = np.sqrt(np.diag(pose.covariance)).reshape(2, 3).max(axis=1).tolist()
    length = f"{1000.0 * shift:.2g} mm" if unit == "m" else f"{shift:.2g} {unit}"
    symmetry_text = "No other pose is as right."
    if (count := len(pose.alternatives)) > 1:
        symmetry_text = f"{count} poses are equally right: the part is symmetric."
    return "\n".join(
        [
            f"{pose.name}: from its mesh, in the unit of the world, to the world",
            *("  ".join(f"{value:+.5f}" for value in row) for row in pose.matrix),
            f"Standard deviations along and about the least certain axes: {length}, {np.degrees(angle):.2g} degrees.",
            symmetry_text,
        ]
    )
