"""What is sought and what is known, in words: what the values of a search mean, and what the cloud answers."""

from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

# An answer that changes by less than this share from one view to the next has settled.
_SETTLED = 0.05


class Quantity(eqx.Module):
    """What a search maximises.

    - `name`, `unit`: in words; the unit is empty where there is none.
    - `meaning`: the rest of a caption that begins with "Value:".
    - `smooth`: whether values between two candidates mean anything.
    """

    name: str
    unit: str
    meaning: str
    smooth: bool = True

    @property
    def label(self) -> str:
        return f"{self.name} ({self.unit})" if self.unit else self.name

    def show(self, value: float) -> str:
        """A value with its unit, where the unit is a length or an area."""
        return f"{number(value)} {self.unit}" if self.unit.startswith("scene units") else number(value)


class Panel(NamedTuple):
    """A chart's numbers at one view.

    - `label`: of its axis, with the unit.
    - `names`, `values`: one each.
    - `true`: what the values would be if all of the surface had been seen; None where that is not known.
    - `bars`: whether they are drawn beside each other, view by view, rather than as lines over the views.
    - `goal`: a value to be reached; None without one.
    """

    label: str
    names: tuple[str, ...]
    values: Float[np.ndarray, " n"]
    true: Float[np.ndarray, " n"] | None = None
    bars: bool = False
    goal: float | None = None


class Answer(eqx.Module):
    """What D tells of the question that the views are for: numbers with names.

    - `names`, `values`: one each.
    - `form`: how a value is written, in the language of `str.format`.

    A task whose answer reads otherwise overrides `line` and `sentence`; one that is charted otherwise, `panels`; one
    that is sure in another sense, `settled` and `settled_means`.
    """

    names: tuple[str, ...]
    values: Float[np.ndarray, " n"]
    form: str = "{:.4g}"

    @property
    def shown(self) -> tuple[int, ...]:
        """Which of the numbers are told."""
        return tuple(range(len(self.names)))

    def line(self, before: "Answer | None" = None) -> str:
        """For the terminal: each number, with what it was before the view."""

        def one(index: int) -> str:
            was = "" if before is None else f"{self.form.format(before.values[index])} -> "
            return f"{self.names[index]} {was}{self.form.format(self.values[index])}"

        return "   ".join(map(one, self.shown))

    def sentence(self, before: "Answer | None" = None) -> str:
        """For the report."""

        def one(index: int) -> str:
            was = "" if before is None else f" (was {self.form.format(before.values[index])})"
            return f"{self.names[index]} {self.form.format(self.values[index])}{was}"

        text = ", ".join(map(one, self.shown))
        return f"{text[:1].upper()}{text[1:]}."

    @property
    def question(self) -> str:
        """What was asked, for the head of the report."""
        names = " and ".join(self.names[index] for index in self.shown)
        return f"{names[:1].upper()}{names[1:]}?"

    @property
    def found(self) -> str:
        """The answer in short."""
        return self.line()

    @property
    def settled_means(self) -> str:
        """What `settled` asks, in words."""
        return f"within {100 * _SETTLED:.0f} % of the view before"

    def settled(self, before: "Answer | None") -> bool:
        """Whether the answer can be relied on, given that of the view before."""
        if before is None:
            return False
        return bool(np.allclose(self.values[list(self.shown)], before.values[list(self.shown)], rtol=_SETTLED))

    def panels(self, truth: "Answer | None") -> tuple[Panel, ...]:
        """Its charts at this view, the same ones at every view.

        `truth`: the answer if all of the surface had been seen; None where that is not known.
        """
        names, shown = tuple(self.names[index] for index in self.shown), list(self.shown)
        return (Panel(", ".join(names), names, self.values[shown], None if truth is None else truth.values[shown]),)


def coordinates(point: Float[np.ndarray, "3"]) -> str:
    """A point in scene units."""
    x, y, z = (f"{coordinate:.2f}".replace("-", "−") for coordinate in point)
    return f"({x}, {y}, {z})"


def number(value: float) -> str:
    """Three significant digits, without an exponent where none is needed."""
    text = f"{value:,.0f}" if 999.5 <= abs(value) < 1e7 else f"{value:.3g}"
    return text.replace("-", "−")
