"""What answers and quantities say, in words and charts; the task that gives them knows numbers only.

`words_of` dispatches on the kind of answer. One of your own is shown by its names and values, or as you register it:

    @words_of.register
    def _(answer: MyAnswer) -> Words: ...
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxnbv.acquisition import Answer, Quantity
from jaxnbv.tasks.classification import ClassAnswer
from jaxnbv.tasks.heat import Coldest
from jaxnbv.tasks.segmentation import PartAnswer

# An answer that changes by less than this share from one view to the next has settled.
_SETTLED = 0.05
# The probability at which a reader may rely on a class.
_SURE = 0.95
_CLASSES_SHOWN, _CLASSES_SAID = 5, 3
_KINDS_SHOWN = 4


class Panel(NamedTuple):
    """A chart's numbers at one view.

    - `label`: of its axis, with the unit.
    - `names`, `values`: one each.
    - `true`: what the values would be if all of the surface had been seen; None where that is not known.
    - `one_true`: whether the truth is one of the names, which stands out, rather than values to be reached.
    - `goal`: a value to be reached; None without one.
    """

    label: str
    names: tuple[str, ...]
    values: Float[np.ndarray, " n"]
    true: Float[np.ndarray, " n"] | None = None
    one_true: bool = False
    goal: float | None = None


class Words:
    """What any answer says; a kind that reads otherwise overrides a part."""

    def __init__(self, answer: Answer):
        self.answer = answer

    @property
    def shown(self) -> tuple[int, ...]:
        """Which of the numbers are shown."""
        return tuple(range(len(self.answer.names)))

    def line(self, before: Answer | None = None) -> str:
        """For the terminal: each number, with what it was before the view."""

        def one(index: int) -> str:
            was = "" if before is None else f"{self._value(before, index)} -> "
            return f"{self.answer.names[index]} {was}{self._value(self.answer, index)}"

        return "   ".join(map(one, self.shown))

    def sentence(self, before: Answer | None = None) -> str:
        """For the report."""

        def one(index: int) -> str:
            was = "" if before is None else f" (was {self._value(before, index)})"
            return f"{self.answer.names[index]} {self._value(self.answer, index)}{was}"

        return f"{capital(', '.join(map(one, self.shown)))}."

    @property
    def question(self) -> str:
        """What was asked, for the head of the report."""
        return f"{capital(' and '.join(self.answer.names[index] for index in self.shown))}?"

    @property
    def found(self) -> str:
        """The answer in short."""
        return self.line()

    @property
    def truly(self) -> str:
        """The same of an answer that is the truth."""
        return self.found

    @property
    def settled_means(self) -> str:
        """What `settled` asks."""
        return f"within {100 * _SETTLED:.0f} % of the view before"

    def settled(self, before: Answer | None) -> bool:
        """Whether the answer can be relied on, given that of the view before."""
        if before is None:
            return False
        shown = list(self.shown)
        return bool(np.allclose(self.answer.values[shown], before.values[shown], rtol=_SETTLED))

    def panels(self, truth: Answer | None) -> tuple[Panel, ...]:
        """Its charts at this view, the same ones at every view.

        `truth`: the answer if all of the surface had been seen; None where that is not known.
        """
        names, shown = tuple(self.answer.names[index] for index in self.shown), list(self.shown)
        true = None if truth is None else truth.values[shown]
        return (Panel(", ".join(names), names, self.answer.values[shown], true),)

    def _value(self, answer: Answer, index: int) -> str:
        return self.answer.form.format(answer.values[index])


@functools.singledispatch
def words_of(answer: Answer) -> Words:
    """What an answer says."""
    return Words(answer)


@words_of.register(ClassAnswer)
class _ClassWords(Words):
    """The likeliest five classes are shown."""

    answer: ClassAnswer
    question = "Which class is it?"
    settled_means = f"probability {_SURE} or more"

    @property
    def shown(self) -> tuple[int, ...]:
        return tuple(sorted(np.argsort(-self.answer.values)[:_CLASSES_SHOWN].tolist()))

    def line(self, before: Answer | None = None) -> str:
        """The likeliest three, in percent."""
        best = np.argsort(-self.answer.values)[:_CLASSES_SAID].tolist()

        def one(index: int) -> str:
            was = "" if before is None else f"{100 * before.values[index]:.0f} -> "
            return f"{self.answer.names[index]} {was}{100 * self.answer.values[index]:.0f} %"

        return "   ".join(map(one, best))

    @property
    def _best(self) -> tuple[str, float]:
        best = int(np.argmax(self.answer.values))
        return self.answer.names[best], float(self.answer.values[best])

    def sentence(self, before: Answer | None = None) -> str:
        name, p = self._best
        text = f"The classifier says {name} with probability {p:.2f}"
        if before is not None:
            best, previous = int(np.argmax(self.answer.values)), int(np.argmax(before.values))
            behind = f", behind {self.answer.names[previous]} with {before.values[previous]:.2f}"
            text += f" (was {before.values[best]:.2f}{'' if best == previous else behind})"
        return f"{text}."

    @property
    def found(self) -> str:
        name, p = self._best
        return name if p == 1.0 else f"{name}, probability {p:.2f}"

    def settled(self, before: Answer | None) -> bool:
        """Sure, and not of another class than the view before was sure of."""
        values = self.answer.values
        contradicted = (
            before is not None
            and before.values.max() >= _SURE
            and int(np.argmax(before.values)) != int(np.argmax(values))
        )
        return bool(values.max() >= _SURE) and not contradicted

    def panels(self, truth: Answer | None) -> tuple[Panel, ...]:
        """The probabilities of all classes; of the truth, 1 and 0."""
        true = None if truth is None else truth.values
        return (Panel("probability", self.answer.names, self.answer.values, true, one_true=True, goal=_SURE),)


@words_of.register(PartAnswer)
class _PartWords(Words):
    """The parts that were asked for are shown."""

    answer: PartAnswer
    question = "Which parts does it have?"

    @property
    def shown(self) -> tuple[int, ...]:
        return self.answer.asked

    def line(self, before: Answer | None = None) -> str:
        """The points of each part, without those before: up to six parts fit into a line."""
        return super().line()

    def sentence(self, before: Answer | None = None) -> str:
        names, values = self.answer.names, self.answer.values
        listed = ", ".join(f"{names[index]} {values[index]:.0f}" for index in self.shown) or "none"
        return f"Points predicted of each part: {listed}."

    @property
    def found(self) -> str:
        names, values = self.answer.names, self.answer.values
        return ", ".join(names[index] for index in self.shown if values[index] >= self.answer.target) or "no part yet"

    @property
    def truly(self) -> str:
        return ", ".join(self.answer.names[index] for index in self.shown if self.answer.values[index] > 0)

    @property
    def settled_means(self) -> str:
        return f"{self.answer.target:g} points or more of every part"

    def settled(self, before: Answer | None) -> bool:
        return all(self.answer.values[index] >= self.answer.target for index in self.shown)

    def panels(self, truth: Answer | None) -> tuple[Panel, ...]:
        """The points of each part, and how many parts have N_target of them; of the truth, those that it has at all."""
        values, target = self.answer.values, self.answer.target
        shown = sorted({*self.shown, *(() if truth is None else words_of(truth).shown)})
        names = tuple(self.answer.names[index] for index in shown)
        found = np.array([np.sum(values[shown] >= target)], np.float64)
        there = None if truth is None else np.array([np.sum(truth.values[shown] > 0)], np.float64)
        points = Panel("points predicted of each part", names, values[shown], goal=target)
        return Panel(f"parts found ({target:g} points or more)", ("parts",), found, there), points


@words_of.register(Coldest)
class _ColdestWords(Words):
    """Where the cloud is coldest, and how cold it is there."""

    answer: Coldest
    question = "Where does it stay coldest while it is heated?"

    def line(self, before: Answer | None = None) -> str:
        change = "" if before is None else f" (was {number(float(before.values[0]))})"
        return f"coldest at {coordinates(self.answer.point)}, {number(float(self.answer.values[0]))} degrees{change}"

    def sentence(self, before: Answer | None = None) -> str:
        return f"The cloud is {self.line(before)}."

    def panels(self, truth: Answer | None) -> tuple[Panel, ...]:
        """The temperature of the coldest point and, where the truth is known, its distance to the true one."""
        true = None if truth is None else truth.values
        temperature = Panel("lowest temperature (degrees)", ("coldest",), self.answer.values, true)
        if not isinstance(truth, Coldest):
            return (temperature,)
        distance = np.array([np.linalg.norm(self.answer.point - truth.point)])
        label = "distance to the true coldest point (scene units)"
        return temperature, Panel(label, ("distance",), distance, goal=0.0)


class CoverageAnswer(Answer):
    """How much of the surface was seen: a share of the true one or, where that is not known, the area of what was."""

    is_share: bool = True

    @classmethod
    def of_share(cls, share: float) -> "CoverageAnswer":
        return cls(("of the surface seen",), np.array([share]))

    @classmethod
    def of_area(cls, area: float) -> "CoverageAnswer":
        """In squared scene units."""
        return cls(("of surface seen",), np.array([area]), is_share=False)

    @property
    def unit(self) -> str:
        """Of `scaled`."""
        return "%" if self.is_share else "scene units²"

    @property
    def scaled(self) -> float:
        """In percent, or the area."""
        return float(self.values[0]) * (100.0 if self.is_share else 1.0)

    @property
    def label(self) -> str:
        """For an axis of `scaled` values."""
        return f"surface seen ({self.unit})"

    @property
    def amount(self) -> str:
        """In words."""
        return f"{self.figure} {self.unit}"

    @property
    def figure(self) -> str:
        """The same without a unit."""
        return f"{self.scaled:.0f}" if self.is_share else number(self.scaled)


@words_of.register(CoverageAnswer)
class _CoverageWords(Words):
    answer: CoverageAnswer
    question = "What does it look like all round?"

    @property
    def found(self) -> str:
        return f"{self.answer.amount} {self.answer.names[0]}"

    def panels(self, truth: Answer | None) -> tuple[Panel, ...]:
        goal = 100.0 if self.answer.is_share else None
        return (Panel(self.answer.label, self.answer.names, np.array([self.answer.scaled]), goal=goal),)


def label_of(quantity: Quantity) -> str:
    """A quantity's name with its unit."""
    return f"{quantity.name} ({quantity.unit})" if quantity.unit else quantity.name


def shown_value(quantity: Quantity, value: float) -> str:
    """A value with its unit, where the unit is a length or an area."""
    return f"{number(value)} {quantity.unit}" if quantity.unit.startswith("scene units") else number(value)


def coordinates(point: Float[np.ndarray, "3"]) -> str:
    """A point in scene units."""
    x, y, z = (f"{coordinate:.2f}".replace("-", "−") for coordinate in point)
    return f"({x}, {y}, {z})"


def capital(text: str) -> str:
    """A text that starts with a capital letter, and is otherwise as it was."""
    return text[:1].upper() + text[1:]


def number(value: float) -> str:
    """Three significant digits, without an exponent where none is needed."""
    text = f"{value:,.0f}" if 999.5 <= abs(value) < 1e7 else f"{value:.3g}"
    return text.replace("-", "−")


def may_be_words(kinds: Sequence[tuple[str, float]]) -> str:
    """What the known shapes say that the object may be, the likeliest first."""
    shown = [f"{name} {weight:.2f}" for name, weight in kinds[:_KINDS_SHOWN]]
    rest = sum(weight for _, weight in kinds[_KINDS_SHOWN:])
    return f"By the shapes that fit, it may be: {', '.join(shown)}{f', others {rest:.2f}' if rest else ''}."
