"""Why a view was chosen: candidates and ascents on a map of the sphere, and the candidates by value."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from jaxnbv.acquisition import Quantity
from jaxnbv.viz import sphere
from jaxnbv.viz.answers import label_of, number
from jaxnbv.viz.choice import Ascents, Choice
from jaxnbv.viz.layout import fitted, flow
from jaxnbv.viz.style import GREY, INK, LINE, NEW, VALUE


def draw_choice(figure: Figure | SubFigure, choice: Choice | None, quantity: Quantity) -> None:
    """Draw the map, and under it the candidates by value over a colour bar; of a given view the map's grid alone."""
    if choice is None:
        draw_acquisition(figure.add_axes((0.04, 0.2, 0.92, 0.7)), None, quantity)
        return
    marks = [
        ("★ chosen", NEW, True),
        ("× visited", INK, bool(choice.visited.any())),
        ("◯ level with it", INK, choice.rings_tied),
        ("○ start, ● end of an ascent", INK, choice.ascents is not None),
        ("(directions of the cameras)", GREY, choice.ascents is not None and choice.ascents.is_spatial),
    ]
    flow(figure, [(text, colour) for text, colour, there in marks if there], 0.04, 0.96, 0.94, 0.045, 8.0)
    colours = draw_acquisition(figure.add_axes((0.06, 0.36, 0.88, 0.53)), choice, quantity)
    draw_candidates(figure.add_axes((0.14, 0.16, 0.72, 0.19)), choice)
    assert colours is not None
    bar = figure.colorbar(colours, cax=figure.add_axes((0.14, 0.125, 0.72, 0.024)), orientation="horizontal")
    bar.outline.set_visible(False)
    bar.locator = MaxNLocator(5)
    bar.formatter = FuncFormatter(lambda value, _: number(value))
    label = label_of(quantity) if choice.errors is None else f"{label_of(quantity)}; lines: standard errors"
    fitted(figure, 0.5, 0.025, label, 0.94, 9.0, ha="center", va="center")


def draw_candidates(axes: Axes, choice: Choice) -> None:
    """Draw the values of the open candidates, the best on top, with their standard errors, over a colour bar of the
    same range."""
    order = np.argsort(-choice.values)[: len(choice.open_values)]
    values, rows = choice.values[order], -np.arange(len(order))
    if choice.errors is not None:
        axes.hlines(rows, values - choice.errors[order], values + choice.errors[order], color=GREY, lw=0.6, zorder=1)
    axes.scatter(values, rows, s=4, color=INK, linewidths=0, zorder=2)
    axes.plot(choice.value, 1.0, "*", color=NEW, ms=8, markeredgecolor="white", zorder=3, clip_on=False)
    axes.set(xlim=choice.range, ylim=(-len(order), 3.0 + 0.05 * len(order)))
    axes.axis("off")


def draw_acquisition(
    axes: Axes, choice: Choice | None, quantity: Quantity, weight: float = 1.0
) -> ScalarMappable | None:
    """Draw the candidates' values as a map of the sphere; returns what a colour bar needs, None for a given view."""
    axes.axis("off")
    globe: Any = axes.inset_axes((0.0, 0.0, 1.0, 1.0), projection="mollweide")
    globe.set_longitude_grid(60)
    globe.set_latitude_grid(30)
    globe.set_longitude_grid_ends(90)
    globe.grid(color=LINE, lw=0.5 * weight, alpha=0.6)
    globe.tick_params(labelbottom=False, labelleft=False)
    globe.spines["geo"].set(color=GREY, linewidth=0.8 * weight)
    if choice is None:
        globe.text(0.0, 0.0, "given", ha="center", va="center", color=GREY, fontsize=11 * weight)
        return None
    colours = ScalarMappable(Normalize(*choice.range), VALUE)
    if choice.makes_a_map(quantity):
        globe.pcolormesh(*sphere.smooth_map(choice.directions, choice.values), cmap=VALUE, norm=colours.norm)
    places, shown = sphere.on_map(choice.directions), ~choice.visited
    dots: dict[str, Any] = {"s": 14 * weight, "edgecolors": GREY, "linewidths": 0.6 * weight, "clip_on": False}
    globe.scatter(*places[shown].T, c=colours.to_rgba(choice.values[shown]), **dots, zorder=3)
    if choice.tied is not None and choice.rings_tied:
        rings: dict[str, Any] = {"s": 52 * weight, "facecolors": "none", "edgecolors": INK, "clip_on": False}
        globe.scatter(*places[choice.tied & shown].T, linewidths=1.0 * weight, **rings, zorder=4)
    globe.scatter(*places[~shown].T, marker="x", c=INK, s=26 * weight, linewidths=1.2 * weight, zorder=4)
    if choice.ascents is not None:
        _draw_ascents(globe, choice.ascents, weight)
    size = 14 if choice.ascents is None else 11
    star: dict[str, Any] = {"ms": size * weight**0.5, "color": NEW, "markeredgecolor": "white", "mew": 1.0}
    globe.plot(*sphere.on_map(choice.chosen[None]).T, "*", **star, zorder=10, clip_on=False)
    return colours


def _draw_ascents(globe: Any, ascents: Ascents, weight: float) -> None:
    """Draw trajectories on the map, each from a ring to a dot."""
    for directions in ascents.directions:
        way = sphere.path(directions).T
        globe.plot(*way, color="white", lw=2.2 * weight, zorder=6)
        globe.plot(*way, color=INK, lw=1.1 * weight, zorder=7)
    mark: dict[str, Any] = {"ls": "none", "marker": "o", "clip_on": False}
    starts, ends = (sphere.on_map(ascents.directions[:, step]).T for step in (0, -1))
    globe.plot(*starts, ms=4.6 * weight, mew=1.0 * weight, mfc="white", mec=INK, zorder=8, **mark)
    globe.plot(*ends, ms=3.4 * weight, mew=0.5 * weight, mfc=INK, mec="white", zorder=9, **mark)
