"""Which frames of a recording each method chose, and what they have shown."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from jaxnbv.studies.engine.measures import Record
from jaxnbv.studies.engine.pictures import Tiles, say
from jaxnbv.studies.recorded.study import RecordedStudy
from jaxnbv.viz.style import GREY, INK, LINE, NEW


def tiles(study: RecordedStudy, record: Record, methods: Sequence[str], pixels: int) -> Tiles:
    """The voxels of the box across its shortest side, those that the frames so far have shown in colour, the way of the
    recorded camera, and where the chosen frames were taken, in their order."""
    recording, held = study.recording, record["methods"]
    kept = np.sort(np.argsort(np.subtract(study.box.high, study.box.low))[1:])
    voxels, places = recording.voxels[:, kept], recording.places[:, kept]

    def tile(axes: Axes, method: str, view: int) -> None:
        frames = held[method]["frames"][: view + 1]
        seen = recording.shown[frames].any(axis=0)
        for which, colour in ((~seen, LINE), (seen, NEW)):
            axes.scatter(voxels[which, 0], voxels[which, 1], s=2.0, c=colour, linewidths=0)
        axes.plot(places[:, 0], places[:, 1], color=GREY, lw=0.6)
        axes.scatter(places[frames, 0], places[frames, 1], s=14.0, c=INK, zorder=3)
        for number, place in enumerate(places[frames], start=1):
            axes.annotate(str(number), place, textcoords="offset points", xytext=(3, 3), fontsize=8, zorder=4)
        axes.set_aspect("equal")
        say(axes, f"{held[method]['covered'][view]:.0%}")

    return Tiles("Coloured: voxels that the frames show. Numbers: where they were taken, in their order.", tile)
