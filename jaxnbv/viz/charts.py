"""Draws charts of an episode over the views: answers, surface seen, and values of the chosen views."""

import textwrap
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, MaxNLocator

from jaxnbv.viz.answers import Chart, label_of, number_text
from jaxnbv.viz.choice import descending_values
from jaxnbv.viz.data import ReportData
from jaxnbv.viz.style import GREY, INK, LINE, NEW, SERIES

# Largest numbers of lines in a chart, of letters in a name, and of views up to which the chart prints values.
_MAX_LINES, _MAX_LETTERS, _MAX_VIEWS = 6, 22, 10
# Lines that differ by less than this fraction of the range of values look like one line.
_MIN_DIFFERENCE = 0.02
# Sizes in inches. On a phone (390 pixels wide), the letters of a large chart are eleven pixels tall.
_LARGE, _SMALL = (4.0, 2.6), (3.1, 2.6)
_LEGEND: dict[str, Any] = {"loc": "outside lower center", "frameon": False, "fontsize": 9, "handlelength": 1.4}


def visible_lines(chart: Chart) -> dict[int, int]:
    """Return the indices of the lines to draw, each with the number of nearly equal lines that it hides.

    At most six lines are drawn: those whose largest value, or true value, is highest.
    """
    largest = chart.values.max(axis=0)
    largest = largest if chart.true is None else np.maximum(largest, chart.true)
    tolerance = _MIN_DIFFERENCE * max(float(np.ptp(chart.values)), 1e-12)
    num_hidden = dict[int, int]()
    for index in np.argsort(-largest, kind="stable").tolist():
        distances = {other: np.abs(chart.values[:, other] - chart.values[:, index]).max() for other in num_hidden}
        coinciding = (other for other, distance in distances.items() if distance < tolerance)
        # The line of the true name hides no other line. If every line has a true value of its own, none is hidden.
        front = next(coinciding, None) if chart.true is None or chart.marks_true_name else None
        if front is not None and not (chart.marks_true_name and chart.true is not None and chart.true[front] > 0):
            num_hidden[front] += 1
        elif len(num_hidden) < _MAX_LINES:
            num_hidden[index] = 0
    return dict(sorted(num_hidden.items()))


def draw_chart(axes: Axes, chart: Chart, rival: Chart | None = None, rival_name: str = "") -> list[Line2D]:
    """Draw the numbers and their true values as lines over the views, and return the entries of a legend.

    - `rival`, `rival_name`: the chart of a different search, and the name of that search. If the chart has several
      lines, only the line of the true name is drawn.
    """
    views, is_one = np.arange(1, len(chart.values) + 1), len(chart.names) == 1
    true_index = None if chart.true is None or not chart.marks_true_name else int(np.argmax(chart.true))
    colours, handles = iter(SERIES * 2), list[Line2D]()
    for index, num_hidden in visible_lines(chart).items():
        name = textwrap.shorten(chart.names[index], _MAX_LETTERS, placeholder="…")
        name += f" and {num_hidden} more" if num_hidden else ""
        colour, label = (NEW, f"{name} (true)") if index == true_index else (next(colours), name)
        style: dict[str, Any] = {"color": colour, "lw": 1.6, "marker": "o", "ms": 5, "markeredgecolor": "white"}
        lines = axes.plot(views, chart.values[:, index], label=label, zorder=3, **style)
        handles += [] if is_one else lines
        if chart.true is not None and not chart.marks_true_name:
            axes.axhline(chart.true[index], color=colour, lw=1.2, ls="--", zorder=1)
    if chart.true is not None and not chart.marks_true_name:
        handles.append(Line2D([], [], color=GREY, lw=1.2, ls="--", label="in truth"))
    if is_one and len(views) <= _MAX_VIEWS:
        for view, value in zip(views.tolist(), chart.values[:, 0].tolist(), strict=True):
            style = {"textcoords": "offset points", "ha": "center", "fontsize": 8}
            axes.annotate(number_text(value), (view, value), (0, 6), **style)
    rival_index = 0 if is_one else true_index
    if rival is not None and rival_index is not None:
        style = {"color": GREY, "lw": 1.4, "ls": (0, (4, 2)), "marker": "s", "ms": 3.5}
        rival_views = np.arange(1, len(rival.values) + 1)
        handles += axes.plot(rival_views, rival.values[:, rival_index], label=rival_name, zorder=2, **style)
    if chart.goal is not None:
        axes.axhline(chart.goal, color=GREY, lw=1.0, ls=":", zorder=1)
    low, high = axes.get_ylim()
    axes.set_ylim(min(low, 0.0) if chart.values.min() >= 0 else low, high + 0.1 * (high - low))
    set_view_axis(axes, len(chart.values) if rival is None else max(len(chart.values), len(rival.values)))
    return handles


def set_view_axis(axes: Axes, count: int) -> None:
    """Let the horizontal axis run over views 1 to `count`, with a margin of half a view on both sides."""
    axes.set(xlabel="view", xlim=(0.5, count + 0.5))
    axes.xaxis.set_major_locator(MaxNLocator(min(count, 10), integer=True, min_n_ticks=1))
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: number_text(value)))


def draw_values(axes: Axes, data: ReportData) -> list[Line2D]:
    """Draw each chosen view's value and standard error, and the candidates' median. Return legend entries."""
    for view, view_data in enumerate(data.views, start=1):
        if view_data.proposal is None:
            axes.annotate("given", (view, 0), (0, 4), textcoords="offset points", ha="center", color=GREY, fontsize=8)
            continue
        value, error = float(view_data.proposal.value), view_data.proposal.standard_error
        axes.vlines(view, 0.0, value, color=LINE, lw=1.5, zorder=1)
        if error is not None and np.isfinite(error):
            axes.errorbar(view, value, error, color=INK, lw=1.2, capsize=3, zorder=2)
        axes.plot(view, value, "*", color=NEW, ms=11, markeredgecolor="white", zorder=3)
        if len(values := descending_values(view_data.proposal)):
            axes.plot(view, np.median(values), "_", color=INK, ms=11, mew=1.4, zorder=2)
    low, high = axes.get_ylim()
    axes.set_ylim(min(low, 0.0), high * 1.12)
    set_view_axis(axes, len(data.views))
    has_errors = any(proposal.standard_error is not None for proposal in data.proposals)
    label = "chosen view" + " ± standard error" * has_errors
    star = Line2D([], [], ls="none", marker="*", color=NEW, ms=9, label=label)
    return [star, Line2D([], [], ls="none", marker="_", color=INK, ms=9, mew=1.4, label="median candidate")]


def task_charts(data: ReportData) -> list[tuple[str, Figure]]:
    """Return the title and the figure of each chart of the task."""
    task, size = data.task, _LARGE if len(data.task.charts) == 1 else _SMALL
    others = [None] * len(task.charts) if task.rival is None else task.rival.charts
    return [_labelled_figure(data, chart, other, size) for chart, other in zip(task.charts, others, strict=True)]


def other_charts(data: ReportData) -> list[tuple[str, Figure]]:
    """Return titles and figures of charts: surface seen (unless that is the task), and values of views."""
    rival = None if data.task.rival is None else data.task.rival.coverage_chart
    charts = [] if data.task.is_coverage else [_labelled_figure(data, data.task.coverage_chart, rival, _LARGE)]
    if data.proposals:
        figure = Figure(figsize=_LARGE, layout="constrained")
        figure.legend(handles=draw_values(figure.subplots(), data), ncols=2, **_LEGEND)
        charts.append((label_of(data.quantity, data.episode.frame), figure))
    return charts


def _labelled_figure(
    data: ReportData, chart: Chart, rival: Chart | None, size: tuple[float, float]
) -> tuple[str, Figure]:
    figure = Figure(figsize=size, layout="constrained")
    handles = draw_chart(figure.subplots(), chart, rival, "" if data.task.rival is None else data.task.rival.name)
    if handles:
        # An inch holds twelve letters. A legend entry's mark and gap are six letters wide.
        longest = max(len(str(handle.get_label())) for handle in handles) + 6
        columns = max(1, min(len(handles), int(12 * size[0]) // longest))
        figure.legend(handles=handles, ncols=columns, columnspacing=1.2, **_LEGEND)
    return chart.label, figure
