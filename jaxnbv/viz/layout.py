"""Letters that neither collide nor leave the picture: they are measured before they are placed. Frames, pixels."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import UInt8
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure, SubFigure
from matplotlib.text import Text

_SMALLEST = 5.0


def framed(axes: Axes, colour: str, width: float) -> None:
    """A picture without ticks, in a frame."""
    axes.set(xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set(visible=True, color=colour, linewidth=width)


def pixels_of(figure: Figure, dpi: int) -> UInt8[np.ndarray, "h w 4"]:
    """A figure as an image, drawn at so many dots per inch."""
    canvas = FigureCanvasAgg(figure)
    figure.set_dpi(dpi)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())


def width_of(text: Text, figure: Figure | SubFigure) -> float:
    """Of a text, as a share of the figure's width."""
    return float(text.get_window_extent().width / figure.bbox.width)


def fitted(figure: Figure | SubFigure, x: float, y: float, text: str, width: float, fontsize: float, **style) -> Text:
    """A text at a place of the figure, its letters as small as it takes for `width`; cut where they would be too
    small."""
    placed = figure.text(x, y, text, fontsize=fontsize, **style)
    if (share := width / max(width_of(placed, figure), 1e-9)) < 1.0:
        placed.set_fontsize(max(_SMALLEST, 0.97 * share * fontsize))
        while width_of(placed, figure) > width and len(text) > 1:
            text = text[:-1]
            placed.set_text(f"{text}…")
    return placed


def flow(
    figure: Figure | SubFigure,
    items: Iterable[tuple[str, str]],
    x: float,
    y: float,
    width: float,
    step: float,
    fontsize: float,
) -> None:
    """Texts with their colours from left to right within a width, in as many rows as they need, `step` apart."""
    at, gap = x, 0.14 * figure.dpi / figure.bbox.width
    for text, colour in items:
        placed = figure.text(at, y, text, color=colour, fontsize=fontsize, va="center")
        wide = width_of(placed, figure)
        if at > x and at + wide > x + width:
            at, y = x, y - step
            placed.set_position((at, y))
        at += wide + gap
