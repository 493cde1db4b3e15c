"""Charts of a study as PNG files: its measures by view, a line a method, with intervals over scenes."""

import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxnbv.storage.files import make_folder
from jaxnbv.studies.engine.measures import UNKNOWING, Measure, Record, methods_of
from jaxnbv.studies.engine.results import means
from jaxnbv.studies.engine.study import Panel, Study
from jaxnbv.studies.engine.tables import count_of
from jaxnbv.viz.figures import STYLE
from jaxnbv.viz.style import GREY, INK, LINE, log_ticks, save_figure

# Methods side by side, so that equal values do not hide one another: of the distance between two columns.
_DODGE, _DODGE_NAMED = 0.06, 0.13


class Look(NamedTuple):
    """Colours that colour-blind readers tell apart (Okabe and Ito); line and marker tell the rest apart in print."""

    colour: str
    line: str
    marker: str


# What is new stands out in vermilion, its variants beside it; baselines have the same look in every study.
_FIRST, _SECOND, _THIRD = Look("#d55e00", "-", "o"), Look("#cc79a7", "-", "v"), Look("#e69f00", "-", "^")
LOOKS = {
    "cross-entropy": _FIRST,
    "new surface": _FIRST,
    "evenly spaced": Look("#cc79a7", "--", "v"),
    "entropy": _SECOND,
    "mixed": _THIRD,
    "tie-break": Look("#a33b00", "--", "h"),
    "discrete": _FIRST,
    "gradient-2dof": _THIRD,
    "gradient-6dof": _SECOND,
    "gradient-constrained": _SECOND,
    "halving": Look("#009e73", "--", "D"),
    "hybrid": Look("#0072b2", "--", "s"),
    "heat": _FIRST,
    "heat-reached": _SECOND,
    "heat-halving": Look("#e69f00", "--", "^"),
    "coverage": Look("#009e73", "-", "D"),
    "farthest": Look("#0072b2", "-", "s"),
    f"coverage{UNKNOWING}": Look("#009e73", ":", "d"),
    f"uncertainty{UNKNOWING}": Look("#56b4e9", ":", "p"),
    "uncertainty": Look("#56b4e9", "-", "P"),
    "random": Look(GREY, "--", "X"),
    "oracle": Look(INK, ":", "*"),
}
# Methods of one's own, in turn.
_OTHERS = (Look("#8c564b", "-", "p"), Look("#7f3fbf", "-", "h"), Look("#b8860b", "--", "d"))
_SIZES = {"*": 8.0, "o": 5.0, "P": 6.0, "X": 6.0}


def write_charts(records: Sequence[Record], study: type[Study], folder: str | Path) -> list[Path]:
    """Write the study's charts into a folder, and return their paths. Bars at the views are bootstrap intervals: bands
    between the views of so many methods would hide one another.

    **Raises:** `ValueError` if there are no records, no method that all of them hold, or their numbers of views differ.
    """
    methods_of(records, study.methods)
    folder = make_folder(folder)
    groups, paths = study.groups(records), []
    with mpl.rc_context(STYLE):
        for name, chart in study.charts.items():
            rows = [(group, members, chart.rows[0]) for group, members in groups.items() if group != "all"]
            rows = rows if chart.by_group else [("all", list(records), row) for row in chart.rows]
            figure = _figure(rows, study) if rows else None
            if figure is not None:
                paths.append(folder / f"{name}.png")
                save_figure(figure, paths[-1])
    return paths


def _figure(rows: Sequence[tuple[str, Sequence[Record], Sequence[Panel]]], study: type[Study]) -> Figure | None:
    """A row of panels for each group of scenes, or for each of the chart's own; None if there is nothing to show."""
    wide = max(len(panels) for _, _, panels in rows)
    figure = Figure(figsize=(8.4, 0.4 + (2.9 if len(rows) == 1 else 2.35 * len(rows))), layout="constrained")
    grid = figure.subplots(len(rows), wide, squeeze=False)
    shown: set[str] = set()
    for number, (line, (group, members, panels)) in enumerate(zip(grid, rows, strict=True)):
        methods = methods_of(members, study.methods)
        for column, (axes, panel) in enumerate(zip(line, panels, strict=True)):
            measure = study.measure(panel.measure)
            found = means(members, methods, [measure])
            shown |= {*found["method"]}
            _draw(axes, found, methods, measure, panel)
            if number == 0 or group == "all":
                axes.set_title(panel.title or measure.title)
            is_repeated = column > 0 and measure.percent and study.measure(panels[column - 1].measure).percent
            unit = f"share of {count_of(len(members), 'scene')} (%)" if measure.percent else measure.unit
            axes.set_ylabel("" if is_repeated else unit + (f"\n{group}" if group != "all" and column == 0 else ""))
    if not shown:
        return None
    named = [method for method in methods_of(rows[0][1], study.methods) if method in shown]
    handles = [Line2D([], [], label=method, **_line_of(method)) for method in named]
    figure.legend(handles=handles, loc="outside right center", frameon=False, fontsize=9, handlelength=2.6)
    return figure


def _draw(axes: Axes, rows: pd.DataFrame, methods: Sequence[str], measure: Measure, panel: Panel) -> None:
    columns = rows["at"].unique().tolist()
    named = any(isinstance(column, str) for column in columns)
    at = {column: float(index if named else column) for index, column in enumerate(columns)}
    spacing = 1.0 if named or len(columns) < 2 else columns[1] - columns[0]
    scale = 100.0 if measure.percent else 1.0
    for index, method in enumerate(methods):
        own = rows[rows["method"] == method]
        dodge = (_DODGE_NAMED if named else _DODGE) * spacing * (index - 0.5 * (len(methods) - 1))
        x = own["at"].map(at).to_numpy(float) + dodge
        look = _line_of(method)
        if measure.paired:
            axes.vlines(x, scale * own["low"], scale * own["high"], color=look["color"], alpha=0.35, lw=2.4, zorder=1)
        # That of the study, which comes first, above the others.
        style = look | {"zorder": 2 + (index == 0)} | ({"ls": "none"} if named else {})
        axes.plot(x, scale * own["mean"], **style)
    if columns:
        ends = list(at.values())
        axes.set(xlim=(ends[0] - 0.5 * spacing, ends[-1] + 0.5 * spacing), xticks=ends)
        axes.set_xticklabels([str(column).replace(" ", "\n") for column in columns])
    axes.set_xlabel("" if named else panel.axis or measure.by)
    _scale(axes, measure, panel)
    axes.grid(axis="y", color=LINE, lw=0.6)
    axes.set_axisbelow(True)


def _scale(axes: Axes, measure: Measure, panel: Panel) -> None:
    if measure.percent:
        axes.set(ylim=(-3, 103), yticks=[0, 25, 50, 75, 100])
    elif panel.log:
        axes.set_yscale("log")
        ticks = log_ticks(*axes.get_ylim()).tolist()
        axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.minorticks_off()
    elif axes.get_ylim()[0] < 0:
        axes.axhline(0.0, color=GREY, lw=0.7, zorder=0)
    else:
        axes.set_ylim(0.0, 1.04 * axes.get_ylim()[1])


def _line_of(method: str) -> dict[str, Any]:
    """A method's line and markers, as arguments of `Axes.plot`; that of a study's first method is thicker."""
    look = LOOKS.get(method) or _OTHERS[zlib.crc32(method.encode()) % len(_OTHERS)]
    ours = look == _FIRST
    line = {"color": look.colour, "ls": look.line, "lw": 2.0 if ours else 1.2}
    size = _SIZES.get(look.marker, 4.4) * (1.2 if ours else 1.0)
    return line | {"marker": look.marker, "ms": size, "markeredgecolor": "white", "mew": 0.4}
