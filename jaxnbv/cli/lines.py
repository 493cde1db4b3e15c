"""Prints each finished view of an episode on the terminal."""

import sys

import numpy as np
from tqdm import tqdm

from jaxnbv.planning.loop import View
from jaxnbv.planning.planner import Planner
from jaxnbv.utility import Answer
from jaxnbv.viz.answers import label_of, number_text, words_of


class ViewPrinter:
    """Prints each view: position, number of points and why it was chosen, then the task's answer."""

    def __init__(self, planner: Planner):
        self.planner, self.count = planner, 0
        self.before: Answer | None = None

    def __call__(self, view: View) -> None:
        if not self.count:
            _print(f"views are chosen by {label_of(self.planner.quantity)}")
        self.count += 1
        position = ", ".join(f"{value:+.2f}" for value in np.asarray(view.pose.position))
        points, choice = f"{int(view.scan.count):,} points", _choice_text(self.planner, view)
        _print(f"view {self.count:<3} ({position})   {points}   {choice}")
        answer = view.answer(self.planner.acquisition)
        if answer is not None:
            _print(f"         {words_of(answer).said(self.before)}")
        self.before = answer


def _print(line: str) -> None:
    """Print a line above the progress bar."""
    tqdm.write(line, file=sys.stdout)


def _choice_text(planner: Planner, view: View) -> str:
    """Return as text why a view was chosen: its value, and its rank by value among the candidates."""
    if view.proposal is None:
        return "given"
    value, values = float(view.proposal.value), np.asarray(view.proposal.values, np.float64)
    values = values[np.isfinite(values)]
    if not planner.quantity.smooth:
        return f"drawn from {len(values)}"
    if view.proposal.trajectories is not None:
        best = float(values.max(initial=-np.inf))
        source = "no ascent found more" if value <= best else f"by ascent from {number_text(best)}"
        return f"{number_text(value)}, {source}"
    rank, tied = 1 + int(np.sum(values > value)), view.proposal.num_tied
    ties = f", tied with {tied}" if tied else ""
    rank_text = "best" if rank == 1 else f"number {rank}"
    return f"{number_text(value)}, {rank_text} of {len(values)} (median {number_text(float(np.median(values)))}){ties}"
