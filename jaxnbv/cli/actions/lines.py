"""What the terminal says of each view of an episode, once it is done."""

import sys

import numpy as np
from tqdm import tqdm

from jaxnbv.acquisition import Answer
from jaxnbv.planning.episode import View
from jaxnbv.planning.planner import Planner
from jaxnbv.viz.answers import words_of


class Lines:
    """Prints the lines of each view: where from, why, and what it answered."""

    def __init__(self, planner: Planner):
        self.planner, self.count = planner, 0
        self.before: Answer | None = None

    def __call__(self, view: View) -> None:
        self.count += 1
        _print(f"view {self.count}   {_line(self.planner, view)}")
        answer = self.planner.acquisition.answer(view.cloud)
        if answer is not None:
            _print(f"         {words_of(answer).line(self.before)}")
        self.before = answer


def _print(line: str) -> None:
    """Above the bar that shows progress."""
    tqdm.write(line, file=sys.stdout)


def _line(planner: Planner, view: View) -> str:
    position = ", ".join(f"{value:+.2f}" for value in np.asarray(view.pose.position))
    line = f"from ({position})   {int(view.scan.count):5d} points, {int(view.cloud.count):5d} kept"
    if view.proposal is None:
        return line
    sought, values = planner.quantity, np.asarray(view.proposal.values)
    values = values[np.isfinite(values)]
    line += f"   {sought.name} {float(view.proposal.value):.4g}, "
    if (ways := view.proposal.trajectories) is None:
        rank = 1 + int(np.sum(values > float(view.proposal.value)))
        line += f"{'the highest' if rank == 1 else f'rank {rank}'} of {len(values)} candidates"
        line += f" (median {np.median(values):.4g})" if sought.smooth else ""
        tied = view.proposal.num_tied
        return line if tied is None else f"{line}, {tied} of them within two standard errors"
    best = values.max(initial=-np.inf)
    better = "found nothing better" if float(view.proposal.value) <= best else f"improved on {best:.4g}"
    return f"{line}where ascent from {len(ways.values)} of {len(values)} candidates {better}"
