"""Why a view was chosen: candidates and ascents on a map of the sphere, and the candidates by value."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import Ellipse
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
    axes.set(xlim=(-2.95, 2.95), ylim=(-1.6, 1.6), aspect="equal")
    axes.axis("off")
    for line in sphere.graticule():
        axes.plot(*line.T, color=LINE, lw=0.5 * weight, alpha=0.6)
    rim = Ellipse((0.0, 0.0), 2 * sphere.WIDTH, 2 * sphere.HEIGHT, fill=False, color=GREY, lw=0.8 * weight, zorder=2)
    axes.add_patch(rim)
    if choice is None:
        axes.text(0.0, 0.0, "given", ha="center", va="center", color=GREY, fontsize=11 * weight)
        return None
    colours = ScalarMappable(Normalize(*choice.range), VALUE)
    if choice.makes_a_map(quantity):
        extent = (-sphere.WIDTH, sphere.WIDTH, -sphere.HEIGHT, sphere.HEIGHT)
        smooth = sphere.smooth_map(choice.directions, choice.values)
        image = axes.imshow(colours.to_rgba(smooth), extent=extent, interpolation="bilinear", zorder=1)
        image.set_clip_path(rim)
    places = sphere.mollweide(choice.directions)
    shown = ~choice.visited
    dots: dict[str, Any] = {"s": 14 * weight, "edgecolors": GREY, "linewidths": 0.6 * weight}
    axes.scatter(places[shown, 0], places[shown, 1], c=colours.to_rgba(choice.values[shown]), **dots, zorder=3)
    if choice.tied is not None and choice.rings_tied:
        x, y = places[choice.tied & shown].T
        axes.scatter(x, y, s=52 * weight, facecolors="none", edgecolors=INK, linewidths=1.0 * weight, zorder=4)
    cross: dict[str, Any] = {"marker": "x", "c": INK, "s": 26 * weight, "linewidths": 1.2 * weight}
    axes.scatter(places[~shown, 0], places[~shown, 1], **cross, zorder=4)
    if choice.ascents is not None:
        draw_ascents(axes, choice.ascents, weight)
    size = 14 if choice.ascents is None else 11
    star: dict[str, Any] = {"ms": size * weight**0.5, "color": NEW, "markeredgecolor": "white", "mew": 1.0}
    axes.plot(*sphere.mollweide(choice.chosen[None]).T, "*", **star, zorder=10)
    return colours


def draw_ascents(axes: Axes, ascents: Ascents, weight: float = 1.0) -> None:
    """Draw trajectories on the map of the sphere, each from a ring to a dot."""
    rim: dict[str, Any] = {"color": "white", "lw": 2.2 * weight, "solid_capstyle": "round", "zorder": 6}
    for directions in ascents.directions:
        for piece in sphere.path(directions):
            axes.plot(*piece.T, **rim)
            axes.plot(*piece.T, color=INK, lw=1.1 * weight, solid_capstyle="round", zorder=7)
    mark: dict[str, Any] = {"ls": "none", "marker": "o"}
    starts, ends = (sphere.mollweide(ascents.directions[:, step]) for step in (0, -1))
    axes.plot(*starts.T, ms=4.6 * weight, mew=1.0 * weight, mfc="white", mec=INK, zorder=8, **mark)
    axes.plot(*ends.T, ms=3.4 * weight, mew=0.5 * weight, mfc=INK, mec="white", zorder=9, **mark)
