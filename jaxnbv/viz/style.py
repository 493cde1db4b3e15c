"""Colours and ranges that the report and the figures share. Colour-blind readers can tell the colours apart."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import Colormap, LinearSegmentedColormap
from matplotlib.figure import Figure

from jaxnbv.storage.files import write_whole

INK, GREY, LINE = "#1f2733", "#7a8494", "#d9dee6"
BEFORE, NEW = "#26344d", "#d55e00"
# Colours of a known shape: scanned, imagined, different in other hypotheses. Colour of space that only other hypotheses
# fill.
PART, IMAGINED, OPEN, DISPUTED = "#6cc5a6", "#d7efe6", "#d5d0ec", "#8c7fc0"
# Colours of several lines in one chart (Okabe and Ito). NEW is not among them, because it marks the true line.
SERIES = ["#0072b2", "#56b4e9", "#009e73", "#e69f00", "#cc79a7", "#7a8494", "#26344d", "#b8b04a"]
# Pale where the surface is known, so that the scanned points stand out there. Dark where it is uncertain.
DEVIATION = LinearSegmentedColormap.from_list("deviation", mpl.colormaps["YlGnBu"](np.linspace(0.04, 0.92, 256)))
# Values of candidates. The hue differs from that of deviations, and from the marks on the map.
VALUE = LinearSegmentedColormap.from_list("value", mpl.colormaps["BuPu"](np.linspace(0.03, 0.95, 256)))


def shape_colours(measured: Float[np.ndarray, " n"], agreed: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """Return the colours (RGB) of a known shape, given `measured` and `agreed` of `PlacedShape`."""
    scanned, imagined, disputed = (np.array(mpl.colors.to_rgb(colour)) for colour in (PART, IMAGINED, OPEN))
    measured, agreed = measured[:, None], agreed[:, None]
    return measured * scanned + (1.0 - measured) * (agreed * imagined + (1.0 - agreed) * disputed)


def colour_scale(colours: Colormap) -> list[list]:
    """Convert a colour map to plotly's format, a list of pairs of position (from 0 to 1) and colour."""
    return [[t, mpl.colors.to_hex(colours(t))] for t in np.linspace(0.0, 1.0, 32).tolist()]


def gradient(colours: Colormap) -> str:
    """Convert a colour map to a CSS gradient from left to right."""
    steps = ", ".join(f"{colour} {100 * position:.0f}%" for position, colour in colour_scale(colours))
    return f"linear-gradient(90deg, {steps})"


def middle_range(values: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Return the 2nd and 98th percentile of positive values, rounded outward to 1, 2 or 5 x 10^n."""
    low, high = np.percentile(values, [2.0, 98.0])
    ticks = log_ticks(low / 10.0, high * 10.0)
    return float(ticks[ticks <= low * 1.0001].max()), float(ticks[ticks >= high * 0.9999].min())


def log_ticks(low: float, high: float) -> Float[np.ndarray, " n"]:
    """Return the numbers 1, 2 and 5 times a power of ten within [low, high]."""
    decades = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
    ticks = np.outer(decades, [1.0, 2.0, 5.0]).ravel()
    return ticks[(ticks >= low * 0.9999) & (ticks <= high * 1.0001)]


def bar_ticks(low: float, high: float) -> list[float]:
    """Return the ticks of a logarithmic colour bar: two to five powers of ten, or else both ends."""
    decades = [tick for tick in log_ticks(low, high).tolist() if round(np.log10(tick), 9).is_integer()]
    return decades[:: -(-len(decades) // 5)] if len(decades) > 1 else [low, high]


def draw_border(axes: Axes, colour: str, width: float) -> None:
    """Remove the ticks of axes, and draw a frame around them."""
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set(visible=True, color=colour, linewidth=width)


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as a PNG file. The file is never left incomplete."""
    write_whole(path, lambda file: figure.savefig(file, format="png", dpi=200))
