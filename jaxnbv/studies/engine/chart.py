"""Chart of a study: one panel per measure, and one line per method, with intervals over scenes."""

import io
import textwrap
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxnbv.studies.engine.measures import WITHOUT_BANK, Measure
from jaxnbv.studies.engine.results import groups_of
from jaxnbv.studies.engine.study import Study
from jaxnbv.viz.figures import STYLE
from jaxnbv.viz.style import GREY, INK, LINE

# File in the folder of a study.
CHART = "chart.png"
# Horizontal offset between methods, as a fraction of the distance between two columns. It keeps equal values apart.
_DODGE = 0.06
_PANELS_A_ROW = 3
# Largest number of characters in a line of a panel's title.
_TITLE_WIDTH = 24
# Colour, line and marker. Most colours are those of Okabe and Ito, which colour-blind readers can tell apart. Lines and
# markers are for prints without colour. The main methods are vermilion, and baselines look the same in every study.
_OURS, _SECOND, _THIRD = ("#d55e00", "-", "o"), ("#cc79a7", "-", "v"), ("#e69f00", "-", "^")
LOOKS = {
    "cross-entropy": _OURS,
    "new surface": _OURS,
    "discrete": _OURS,
    "heat": _OURS,
    "identify": _OURS,
    "entropy": _SECOND,
    "gradient-6dof": _SECOND,
    "gradient-constrained": _SECOND,
    "heat-reached": _SECOND,
    "identify-name": _SECOND,
    "mixed": _THIRD,
    "gradient-2dof": _THIRD,
    "tie-break": ("#a33b00", "--", "h"),
    "evenly spaced": ("#cc79a7", "--", "v"),
    "halving": ("#009e73", "--", "D"),
    "heat-halving": ("#e69f00", "--", "^"),
    "hybrid": ("#0072b2", "--", "s"),
    "coverage": ("#009e73", "-", "D"),
    "farthest": ("#0072b2", "-", "s"),
    "uncertainty": ("#56b4e9", "-", "P"),
    f"coverage{WITHOUT_BANK}": ("#009e73", ":", "d"),
    f"uncertainty{WITHOUT_BANK}": ("#56b4e9", ":", "p"),
    "random": (GREY, "--", "X"),
    "oracle": (INK, ":", "*"),
}
# Looks of methods that `LOOKS` does not contain, such as the user's, in turn.
_OTHERS = (("#8c564b", "-", "p"), ("#7f3fbf", "-", "h"), ("#b8860b", "--", "d"))


def chart(table: pd.DataFrame, study: type[Study]) -> bytes:
    """Draw a chart of a table that `results` returned, with one panel per measure, and return a PNG file.

    It shows means over all scenes, with bootstrap intervals as error bars: bands of this many methods would overlap.
    """
    (group, scenes), *_ = groups_of(table).items()
    rows = table[table["group"] == group]
    measures = [measure for measure in study.measures if (rows["quantity"] == measure.name).any()]
    num_rows, num_columns = -(-len(measures) // _PANELS_A_ROW), min(len(measures), _PANELS_A_ROW)
    file = io.BytesIO()
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(8.4, 0.4 + 2.5 * num_rows), layout="constrained")
        panels = figure.subplots(num_rows, num_columns, squeeze=False).ravel()
        for axes, measure in zip(panels, measures, strict=False):
            _draw(axes, rows[rows["quantity"] == measure.name], measure, rows["method"].unique().tolist())
            unit = f"%, mean of {scenes} scenes" if measure.unit == "%" else measure.unit
            axes.set(title=textwrap.fill(measure.title, _TITLE_WIDTH), xlabel=measure.key_name, ylabel=unit)
        for axes in panels[len(measures) :]:
            axes.axis("off")
        lines = {line.get_label(): line for axes in panels for line in axes.containers}
        figure.legend(lines.values(), lines, loc="outside right center", frameon=False, handlelength=2.6)
        figure.savefig(file, format="png", dpi=200)
    return file.getvalue()


def _draw(axes: Axes, rows: pd.DataFrame, measure: Measure, methods: list[str]) -> None:
    columns = rows["at"].unique().tolist()
    scale = 100.0 if measure.unit == "%" else 1.0
    for index, method in enumerate(methods):
        statistics = scale * rows[rows["method"] == method].set_index("at")[["mean", "low", "high"]].reindex(columns)
        x = np.arange(len(columns)) + _DODGE * (index - 0.5 * (len(methods) - 1))
        bars = np.abs(statistics[["low", "high"]].sub(statistics["mean"], axis=0)).T.to_numpy()
        if statistics["mean"].notna().any():
            axes.errorbar(x, statistics["mean"], bars, label=method, zorder=2 + (index == 0), **_look(method, index))
    axes.set_xticks(range(len(columns)), [str(column).replace(" ", "\n") for column in columns])
    axes.set_xlim(-0.5, len(columns) - 0.5)
    if measure.unit == "%":
        axes.set(ylim=(-3, 103), yticks=[0, 25, 50, 75, 100])
    elif (rows["mean"] >= 0).all():
        axes.set_ylim(0.0, 1.04 * axes.get_ylim()[1])
    axes.grid(axis="y", color=LINE, lw=0.6)
    axes.set_axisbelow(True)


def _look(method: str, index: int) -> dict[str, Any]:
    """Return arguments of `Axes.errorbar` for a method. For methods outside `LOOKS`, `index` decides."""
    colour, line, marker = LOOKS.get(method) or _OTHERS[index % len(_OTHERS)]
    width, size = (2.0, 5.5) if (colour, line, marker) == _OURS else (1.2, 4.4)
    bars = {"ecolor": mpl.colors.to_rgba(colour, 0.35), "elinewidth": 2.4}
    edges = {"markeredgecolor": "white", "mew": 0.4}
    return {"color": colour, "ls": line, "lw": width, "marker": marker, "ms": size, **bars, **edges}
