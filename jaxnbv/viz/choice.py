"""Draws why a view was chosen: a map of candidates and gradient ascents, and candidates by value."""

import textwrap
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.pose import Pose
from jaxnbv.search import Proposal
from jaxnbv.utility import Quantity
from jaxnbv.viz import sphere
from jaxnbv.viz.answers import number_text
from jaxnbv.viz.style import GREY, INK, LINE, NEW, VALUE

# The map is coloured between candidates if there are at least this many.
_MIN_CANDIDATES = 12
# Largest number of letters in a line of the caption.
_MAX_LETTERS = 56


def candidate_values(proposal: Proposal) -> Float[np.ndarray, " c"]:
    """Return the values of a proposal's candidates, NaN for those that were excluded."""
    values = np.asarray(proposal.values, dtype=np.float64)
    return np.where(np.isfinite(values), values, np.nan)


def descending_values(proposal: Proposal) -> Float[np.ndarray, " o"]:
    """Return the values of the candidates that were not excluded, the highest first."""
    values = candidate_values(proposal)
    return np.sort(values[~np.isnan(values)])[::-1]


def colour_range(values: Float[np.ndarray, "*n"]) -> tuple[float, float]:
    """Return the smallest and the largest value, ignoring NaN, or a wider range if the two are equal."""
    numbers = values[~np.isnan(values)]
    if not numbers.size:
        return 0.0, 1.0
    low, high = float(numbers.min()), float(numbers.max())
    return (low, high) if high > low else (low - 0.5, low + 0.5)


def has_rings(proposal: Proposal) -> bool:
    """Return whether to ring the tied candidates: true if some are tied, but no more than a third of all."""
    return 0 < (proposal.num_tied or 0) <= len(proposal.values) // 3


def marks(*proposals: Proposal) -> list[str]:
    """Return the legend entries that the maps of these proposals need: excluded, tied, ascents."""
    has_excluded = any(np.isnan(candidate_values(proposal)).any() for proposal in proposals)
    entries = ["× excluded"] * has_excluded + ["◯ tied with the best"] * any(map(has_rings, proposals))
    has_ascents = any(proposal.trajectories is not None for proposal in proposals)
    return entries + ["○ start, ● end of an ascent"] * has_ascents


def draw_choice(figure: Figure, proposal: Proposal | None, quantity: Quantity, frame: Frame) -> None:
    """Draw a map of the candidates, and below it the candidates by value over a colour bar.

    The values are in the world units of `frame`. For a view without a proposal, the map is empty.
    """
    colours = draw_acquisition(figure.add_axes((0.06, 0.4, 0.88, 0.58)), proposal, quantity)
    if proposal is None or colours is None:
        return
    draw_candidates(figure.add_axes((0.14, 0.19, 0.72, 0.2)), proposal)
    bar = figure.colorbar(colours, cax=figure.add_axes((0.14, 0.155, 0.72, 0.024)), orientation="horizontal")
    bar.outline.set_visible(False)
    bar.locator = MaxNLocator(5)
    bar.formatter = FuncFormatter(lambda value, _: number_text(value))
    errors = "" if proposal.standard_errors is None else ", lines: standard errors"
    unit = f" in {quantity.unit_in(frame)}" if quantity.length_power else ""
    caption = f"all candidates by their value{unit}, best on top{errors}"
    figure.text(0.5, 0.04, textwrap.fill(caption, _MAX_LETTERS), ha="center", va="center")


def draw_candidates(axes: Axes, proposal: Proposal) -> None:
    """Draw one row per candidate (value, standard error). A star on top marks the chosen pose's value."""
    best = descending_values(proposal)
    order = np.argsort(-candidate_values(proposal))[: len(best)]
    rows = -np.arange(len(best))
    if proposal.standard_errors is not None:
        errors = np.asarray(proposal.standard_errors, np.float64)[order]
        axes.hlines(rows, best - errors, best + errors, color=GREY, lw=0.6, zorder=1)
    axes.scatter(best, rows, s=4, color=INK, linewidths=0, zorder=2)
    axes.plot(float(proposal.value), 1.0, "*", color=NEW, ms=8, markeredgecolor="white", zorder=3, clip_on=False)
    axes.set(xlim=colour_range(best), ylim=(-len(best), 3.0 + 0.05 * len(best)))
    axes.axis("off")


def draw_acquisition(
    axes: Axes, proposal: Proposal | None, quantity: Quantity, weight: float = 1.0
) -> ScalarMappable | None:
    """Draw the candidates' values as a map of the sphere, and return the colours for a colour bar.

    If the view was given and has no proposal, the map is empty and the result is None. With at least twelve
    candidates, the map is also coloured between them, unless `quantity.smooth` is False.

    - `weight`: factor for the sizes of lines, marks and letters.
    """
    axes.axis("off")
    globe: Any = axes.inset_axes((0.0, 0.0, 1.0, 1.0), projection="mollweide")
    globe.set_longitude_grid(60)
    globe.set_latitude_grid(30)
    globe.set_longitude_grid_ends(90)
    globe.grid(color=LINE, lw=0.5 * weight, alpha=0.6)
    globe.tick_params(labelbottom=False, labelleft=False)
    globe.spines["geo"].set(color=GREY, linewidth=0.8 * weight)
    if proposal is None:
        globe.text(0.0, 0.0, "given", ha="center", va="center", color=GREY, fontsize=11 * weight)
        return None
    values, directions = candidate_values(proposal), directions_of(proposal.candidates)
    colours, has_value = ScalarMappable(Normalize(*colour_range(values)), VALUE), ~np.isnan(values)
    if quantity.smooth and np.sum(has_value) >= _MIN_CANDIDATES:
        globe.pcolormesh(*sphere.smooth_map(directions, values), cmap=VALUE, norm=colours.norm)
    places = sphere.on_map(directions)
    dots: dict[str, Any] = {"s": 14 * weight, "edgecolors": GREY, "linewidths": 0.6 * weight, "clip_on": False}
    globe.scatter(*places[has_value].T, c=colours.to_rgba(values[has_value]), **dots, zorder=3)
    if has_rings(proposal):
        is_tied = np.asarray(proposal.tied_with_best()) & has_value
        rings: dict[str, Any] = {"s": 52 * weight, "facecolors": "none", "edgecolors": INK, "clip_on": False}
        globe.scatter(*places[is_tied].T, linewidths=1.0 * weight, **rings, zorder=4)
    globe.scatter(*places[~has_value].T, marker="x", c=INK, s=26 * weight, linewidths=1.2 * weight, zorder=4)
    if proposal.trajectories is not None:
        _draw_ascents(globe, directions_of(proposal.trajectories.poses), weight)
    size = 14 if proposal.trajectories is None else 11
    star: dict[str, Any] = {"ms": size * weight**0.5, "color": NEW, "markeredgecolor": "white", "mew": 1.0}
    globe.plot(*sphere.on_map(directions_of(proposal.pose)[None]).T, "*", **star, zorder=10, clip_on=False)
    return colours


def directions_of(poses: Pose) -> Float[np.ndarray, "*n 3"]:
    """Return the unit vectors from the origin to the positions of poses."""
    return sphere.unit(np.asarray(poses.position, dtype=np.float64))


def _draw_ascents(globe: Any, ascents: Float[np.ndarray, "starts steps 3"], weight: float) -> None:
    """Draw each ascent, given as unit vectors, as a line from a ring (start) to a dot (end)."""
    for directions in ascents:
        line = sphere.path(directions).T
        globe.plot(*line, color="white", lw=2.2 * weight, zorder=6)
        globe.plot(*line, color=INK, lw=1.1 * weight, zorder=7)
    mark: dict[str, Any] = {"ls": "none", "marker": "o", "clip_on": False}
    starts, ends = (sphere.on_map(ascents[:, step]).T for step in (0, -1))
    globe.plot(*starts, ms=4.6 * weight, mew=1.0 * weight, mfc="white", mec=INK, zorder=8, **mark)
    globe.plot(*ends, ms=3.4 * weight, mew=0.5 * weight, mfc=INK, mec="white", zorder=9, **mark)
