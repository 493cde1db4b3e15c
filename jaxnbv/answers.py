"""What is sought and what is known, in words: what the values of a search mean, and what the cloud answers."""

import equinox as eqx
import numpy as np
from jaxtyping import Float


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


class Answer(eqx.Module):
    """What D tells of the question that the views are for: numbers with names.

    - `names`, `values`: one each.
    - `form`: how a value is written, in the language of `str.format`.

    A task whose answer reads otherwise overrides `sentence`, or both.
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


def coordinates(point: Float[np.ndarray, "3"]) -> str:
    """A point in scene units."""
    x, y, z = (f"{coordinate:.2f}".replace("-", "−") for coordinate in point)
    return f"({x}, {y}, {z})"


def number(value: float) -> str:
    """Three significant digits, without an exponent where none is needed."""
    text = f"{value:,.0f}" if 999.5 <= abs(value) < 1e7 else f"{value:.3g}"
    return text.replace("-", "−")
