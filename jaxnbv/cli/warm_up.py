"""`jaxnbv warm-up`: compile the programs of a session in advance."""

from dataclasses import dataclass
from typing import Annotated

import typer

import jaxnbv as nbv
from jaxnbv.cli.options import command, sensor_option
from jaxnbv.compiled import keep_compiled

_BOX = (-0.15, -0.15, 0.0, 0.15, 0.15, 0.3)


@dataclass(frozen=True, kw_only=True)
class WarmUpOptions:
    intrinsics: Annotated[
        tuple[float, float, float, float],
        sensor_option(metavar="FX FY CX CY", help="Intrinsics of the camera, in pixels."),
    ]
    size: Annotated[
        tuple[int, int], sensor_option(metavar="HEIGHT WIDTH", help="Number of rows and columns of an image.")
    ]
    nearest: Annotated[float, sensor_option(min=0.0, help="Least depth that the camera measures, in world units.")] = (
        0.0
    )
    farthest: Annotated[
        float | None, sensor_option(help="Largest depth that the camera measures.", show_default="no limit")
    ] = None
    box: Annotated[
        tuple[float, float, float, float, float, float],
        sensor_option(
            metavar="LOW HIGH", help="Two corners of the object's box, z up. Needed only with --nearest or --farthest."
        ),
    ] = _BOX


@command(WarmUpOptions)
def warm_up(options: WarmUpOptions) -> None:
    """Compile and keep the programs of a session with this camera.

    The first proposal of the session then takes seconds. Call nbv.keep_compiled() in your own program to load the
    compiled programs there. If your planner is not the default, call session.rehearse() in your program instead of
    this command.
    """
    (fx, fy, cx, cy), (height, width) = options.intrinsics, options.size
    matrix = [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
    camera = nbv.Camera.from_intrinsics(matrix, height, width, options.nearest, options.farthest)
    session = nbv.Session(camera, (options.box[:3], options.box[3:]), up="z", progress=False)
    typer.echo("compiling, which takes about a minute")
    typer.echo(f"{session.rehearse()}, kept in {keep_compiled()}")
