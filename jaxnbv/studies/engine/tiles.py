"""Pictures of a study: figures of tiles, laid out in inches from their top left corner."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxnbv.storage.files import make_folder
from jaxnbv.studies.engine.measures import Record
from jaxnbv.viz.figures import STYLE
from jaxnbv.viz.style import GREY, LINE, save_figure


class Tiles:
    """A figure of so many inches, with a title at its top left and a caption beneath."""

    def __init__(self, wide: float, tall: float, title: str, caption: str = ""):
        self.wide, self.tall = wide, tall
        self.figure = Figure(figsize=(wide, tall))
        self.write(0.12, 0.18, title, fontsize=10, fontweight="bold")
        if caption:
            down = 0.38 if "\n" not in caption else 0.43
            self.write(0.12, down, caption, fontsize=8, color=GREY)

    def place(self, x: float, down: float, wide: float, tall: float) -> Axes:
        """Axes of this size, their top left corner here."""
        bottom = 1.0 - (down + tall) / self.tall
        return self.figure.add_axes((x / self.wide, bottom, wide / self.wide, tall / self.tall))

    def write(self, x: float, down: float, text: str, **style: Any) -> None:
        """A text, its middle at this height."""
        self.figure.text(x / self.wide, 1.0 - down / self.tall, text, **{"va": "center", **style})


def frame(axes: Axes, colour: str = LINE, width: float = 0.8) -> None:
    """A tile without ticks, in a frame."""
    axes.set(xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set(visible=True, color=colour, linewidth=width)


def save_pictures(
    records: Sequence[Record], folder: str | Path, name: str, draw: Callable[[Record], Figure]
) -> list[Path]:
    """Write `<name>_<scene>.png` for each record into a folder; return the paths."""
    folder = make_folder(folder)
    paths = []
    with mpl.rc_context(STYLE):
        for record in records:
            paths.append(folder / f"{name}_{record['scene']:03d}.png")
            save_figure(draw(record), paths[-1])
    return paths


def first_scenes(records: Sequence[Record], count: int) -> list[Record]:
    """Not picked ones."""
    return sorted(records, key=lambda record: record["scene"])[:count]
