"""The pictures of a recorded place: which frames each method chose, and what they have shown."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

from jaxnbv.studies.engine.measures import Record, methods_of
from jaxnbv.studies.engine.pictures import Grid, first_scenes, write_grids
from jaxnbv.studies.recorded.study import RecordedStudy
from jaxnbv.viz.style import GREY, INK, LINE, NEW

_COLUMNS = 4


def write_pictures(records: Sequence[Record], study: RecordedStudy, folder: str | Path, scenes: int = 3) -> list[Path]:
    """Write `frames_<scene>.png` for the first scenes, not picked ones; return the paths.

    A tile a method: the voxels of the box across its shortest side, those that its frames have shown in colour, the
    way of the recorded camera, and where the chosen frames were taken, in their order.

    **Raises:** `ValueError` as `methods_of` does.
    """
    methods = methods_of(records, study.methods)
    return write_grids(first_scenes(records, scenes), folder, "frames", lambda one: _frames(one, study, methods))


def _frames(record: Record, study: RecordedStudy, methods: Sequence[str]) -> Grid:
    wide = min(_COLUMNS, len(methods))

    def draw(axes: Axes, row: int, column: int) -> None:
        if row * wide + column >= len(methods):
            axes.axis("off")
            return
        method = methods[row * wide + column]
        _draw(axes, study, record["methods"][method]["frames"])
        axes.set_xlabel(f"{method}: {record['methods'][method]['covered'][-1]:.0%}", fontsize=9, color=INK)

    caption = "Coloured: voxels that the frames show. Numbers: where they were taken, in their order."
    rows = -(-len(methods) // wide)
    return Grid(f"{study.title}: {record['name']}", caption, [""] * rows, [""] * wide, draw)


def _draw(axes: Axes, study: RecordedStudy, frames: Sequence[int]) -> None:
    recording = study.recording
    sides = np.subtract(study.box.high, study.box.low)
    kept = np.sort(np.argsort(sides)[1:])
    voxels: Float[np.ndarray, "n 2"] = recording.voxels[:, kept]
    seen = recording.shown[list(frames)].any(axis=0)
    for which, colour in ((~seen, LINE), (seen, NEW)):
        axes.scatter(voxels[which, 0], voxels[which, 1], s=2.0, c=colour, linewidths=0)
    places = recording.places[:, kept]
    axes.plot(places[:, 0], places[:, 1], color=GREY, lw=0.6)
    chosen = places[list(frames)]
    axes.scatter(chosen[:, 0], chosen[:, 1], s=14.0, c=INK, zorder=3)
    for number, place in enumerate(chosen, start=1):
        axes.annotate(str(number), place, textcoords="offset points", xytext=(3, 3), fontsize=8, color=INK, zorder=4)
    axes.set_aspect("equal")
