"""The charts of an episode: its task by view, how much was seen, what the chosen views were worth."""

import itertools
import textwrap
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, MaxNLocator
from matplotlib.transforms import ScaledTranslation

from jaxnbv.viz.answers import Panel, label_of, number
from jaxnbv.viz.data import ReportData
from jaxnbv.viz.style import BEFORE, GREY, INK, LINE, NEW, SERIES

_MOST_NAMES, _LONGEST_NAME = 6, 22
# In inches, from the axis to its legend.
_BELOW = 0.42


def shown_names(panels: tuple[Panel, ...]) -> list[int]:
    """Which numbers of a chart are drawn: all if they are few, else those that are ever the largest, or true."""
    values = np.stack([panel.values for panel in panels])
    true = panels[-1].true
    reached = values.max(axis=0) if true is None else np.maximum(values.max(axis=0), true)
    return sorted(np.argsort(-reached, kind="stable")[:_MOST_NAMES].tolist())


def draw_panel(axes: Axes, panels: tuple[Panel, ...], rival: tuple[Panel, ...] = (), rival_name: str = "") -> None:
    """Draw a chart of the task, of which each view has a panel, as lines over the views, with what is true; of a rival
    the number that the chart is about, where it is about one."""
    last, chosen = panels[-1], shown_names(panels)
    values, views = np.stack([panel.values for panel in panels]), np.arange(1, len(panels) + 1)
    marked = int(np.argmax(last.true)) if last.one_true and last.true is not None else None
    others = iter(SERIES * 2)
    handles: list[Any] = []
    for index in chosen:
        name = textwrap.shorten(last.names[index], _LONGEST_NAME, placeholder="…")
        colour, label = (NEW, f"{name} (true)") if index == marked else (next(others), name)
        axes.plot(views, values[:, index], color=colour, lw=1.6, marker="o", ms=5, markeredgecolor="white", zorder=3)
        handles.append(Line2D([], [], color=colour, marker="o", ms=5, label=label))
        if last.true is not None and not last.one_true:
            axes.axhline(last.true[index], color=colour, lw=1.2, ls="--", zorder=1)
    if last.true is not None and not last.one_true:
        handles.append(Line2D([], [], color=GREY, lw=1.2, ls="--", label="in truth"))
    shown = 0 if len(last.names) == 1 else marked
    if rival and shown is not None:
        handles.append(_draw_rival(axes, np.array([panel.values[shown] for panel in rival]), rival_name))
    if last.goal is not None:
        axes.axhline(last.goal, color=GREY, lw=1.0, ls=":", zorder=1)
    if len(handles) > 1:
        legend_below(axes, handles)
    low, high = axes.get_ylim()
    axes.set_ylim(min(low, 0.0) if values.min() >= 0 else low, high + 0.05 * (high - low))
    over_views(axes, max(len(panels), len(rival)))


def _draw_rival(axes: Axes, values: Float[np.ndarray, " v"], name: str) -> Line2D:
    """Draw what another search came to, behind all else; returns its mark for a legend."""
    style: dict[str, Any] = {"color": GREY, "lw": 1.4, "ls": (0, (4, 2)), "marker": "s", "ms": 3.5}
    axes.plot(np.arange(1, len(values) + 1), values, zorder=2, **style)
    return Line2D([], [], label=name, **style)


def legend_below(axes: Axes, handles: list[Any]) -> None:
    """A legend that stands under the axes, where nothing is drawn."""
    # In inches: the figure's, shared by its columns.
    width = float(axes.figure.bbox.width / axes.figure.dpi)
    spec = axes.get_subplotspec()
    room = width if spec is None else width / spec.get_gridspec().ncols
    # Thirteen letters of this size take an inch, and so do a mark and the gap by it six of them.
    longest = max(len(handle.get_label()) for handle in handles) + 6
    columns = max(1, min(len(handles), int(13 * room) // longest))
    axes.legend(
        handles=handles,
        loc="upper center",
        bbox_to_anchor=(0.5, 0.0),
        # Under the axis's numbers and name, however low the axes are.
        bbox_transform=axes.transAxes + ScaledTranslation(0.0, -_BELOW, axes.figure.dpi_scale_trans),
        ncols=columns,
        frameon=False,
        fontsize=8,
        handlelength=1.4,
        columnspacing=1.2,
    )


def over_views(axes: Axes, count: int) -> None:
    """An axis of views, from half a view before the first to half a view behind the last."""
    axes.set(xlabel="view", xlim=(0.5, count + 0.5))
    axes.xaxis.set_major_locator(MaxNLocator(min(count, 10), integer=True, min_n_ticks=1))
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: number(value)))


def draw_coverage(axes: Axes, data: ReportData) -> None:
    """Draw by view how much was seen."""
    seen = [view.seen for view in data.views]
    values = [answer.scaled for answer in seen]
    axes.plot(range(1, len(seen) + 1), values, color=BEFORE, lw=1.4, marker="o", ms=5, markeredgecolor="white")
    if len(seen) <= 10:
        for view, answer in enumerate(seen, start=1):
            at = view, answer.scaled
            axes.annotate(answer.figure, at, (0, 6), textcoords="offset points", ha="center", fontsize=8)
    highest, count, rival = max(values), len(values), data.task.rival
    if rival is not None:
        others = np.array([answer.scaled for answer in rival.seen])
        legend_below(axes, [_draw_rival(axes, others, rival.name)])
        highest, count = max(highest, float(others.max())), max(count, len(others))
    axes.set(ylim=(0, 1.18 * highest or 1.0))
    over_views(axes, count)


def draw_values(axes: Axes, data: ReportData) -> None:
    """Draw the value of each chosen view, with its standard error, over that of the median candidate."""
    has_error = False
    for view in data.views:
        if view.choice is None:
            below: dict[str, Any] = {"textcoords": "offset points", "ha": "center", "color": GREY, "fontsize": 8}
            axes.annotate("given", (view.number, 0), (0, 4), **below)
            continue
        axes.vlines(view.number, 0.0, view.choice.value, color=LINE, lw=1.5, zorder=1)
        error = view.choice.error
        if error is not None and np.isfinite(error):
            has_error = True
            axes.errorbar(view.number, view.choice.value, error, color=INK, lw=1.2, capsize=3, zorder=2)
        axes.plot(view.number, view.choice.value, "*", color=NEW, ms=11, markeredgecolor="white", zorder=3)
        if view.choice.open_values.size:
            axes.plot(view.number, np.median(view.choice.open_values), "_", color=INK, ms=11, mew=1.4, zorder=2)
    star = Line2D([], [], ls="none", marker="*", color=NEW, ms=9, label="chosen view" + " ± standard error" * has_error)
    median = Line2D([], [], ls="none", marker="_", color=INK, ms=9, mew=1.4, label="median candidate")
    legend_below(axes, [star, median])
    low, high = axes.get_ylim()
    axes.set_ylim(min(low, 0.0), high * 1.12)
    over_views(axes, len(data.views))


def task_charts(data: ReportData) -> list[tuple[str, Any]]:
    """The title of each chart of the task, and what draws it."""
    rival = data.task.rival
    beside = itertools.repeat(()) if rival is None else zip(*rival.panels, strict=True)
    name = "" if rival is None else rival.name
    by_chart = zip(zip(*data.task.panels, strict=True), beside, strict=False)
    return [
        (panels[-1].label, partial(draw_panel, panels=panels, rival=other, rival_name=name))
        for panels, other in by_chart
    ]


def progress_charts(data: ReportData) -> list[tuple[str, Any]]:
    """The charts of how much was seen, and of what the chosen views were worth."""
    return [
        (data.views[0].seen.label, partial(draw_coverage, data=data)),
        (label_of(data.quantity), partial(draw_values, data=data)),
    ]


def other_charts(data: ReportData) -> list[tuple[str, Any]]:
    """Those of `progress_charts` that say more than the charts of the task: how much was seen, where that is not the
    task, and the values, where views were chosen."""
    seen, values = progress_charts(data)
    charts = [] if data.task.is_coverage else [seen]
    if any(view.choice is not None for view in data.views):
        charts.append(values)
    return charts


def chart_figure(draw: Callable[[Axes], object], size: tuple[float, float]) -> Figure:
    """A chart, by what draws it."""
    figure = Figure(figsize=size, layout="constrained")
    draw(figure.subplots())
    return figure
