"""Words and charts for the answers of tasks. The tasks themselves return only numbers.

An answer contains what is known after a view, such as class probabilities. `words_of` dispatches on its type. Answers
of your own type are shown by their names and values, unless you register words for the type:

    @words_of.register
    def _(answer: MyAnswer) -> Words: ...
"""

import functools
import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float

from jaxnbv.geometry.frame import Frame
from jaxnbv.planning.part_rules import Identified
from jaxnbv.planning.stopping import Sure
from jaxnbv.tasks.classification import ClassAnswer
from jaxnbv.tasks.heat import Coldest
from jaxnbv.tasks.identification import IdentityAnswer
from jaxnbv.tasks.segmentation import PartAnswer
from jaxnbv.utility import Answer, Quantity

# An answer is reliable if it changed by less than this fraction since the previous view.
_MAX_CHANGE = 0.05
# Largest numbers of classes, and of kinds of known shapes, that a text names.
_NUM_CLASSES_NAMED, _NUM_KINDS_NAMED = 3, 4
# Largest number of parts in a chart.
_MAX_PARTS = 6

# Function of a stop rule and the index of a view (from 0). It returns whether the rule held after the view.
Holds: TypeAlias = Callable[[Sure, int], bool]


class Chart(NamedTuple):
    """Data of a line chart over the views, with one line for each name.

    - `label`: label of the vertical axis, with the unit.
    - `true`: the values if all of the surface had been seen. None if they are unknown.
    - `marks_true_name`: whether `true` is 1 for the true name and 0 for all others.
    - `goal`: a value that the lines should reach, drawn as a dotted line.
    """

    label: str
    names: tuple[str, ...]
    values: Float[np.ndarray, "views n"]
    true: Float[np.ndarray, " n"] | None = None
    marks_true_name: bool = False
    goal: float | None = None


class Words:
    """Texts and charts about an answer. There are subclasses for particular types of answers."""

    def __init__(self, answer: Answer):
        self.answer = answer

    @property
    def shown(self) -> Sequence[int]:
        """Indices, into `answer.names` and `answer.values`, of the numbers that texts show."""
        return range(len(self.answer.names))

    @property
    def question(self) -> str:
        """The question of the task, for the head of the report."""
        return f"{capital(' and '.join(self.answer.names[index] for index in self.shown))}?"

    def value(self, answer: Answer, index: int) -> str:
        """Return number `index` of an answer as text."""
        return answer.form.format(answer.values[index])

    def said(self, before: Answer | None = None) -> str:
        """Return the shown numbers as text, each with its value in the earlier answer `before`."""

        def text_of(index: int) -> str:
            was = "" if before is None else f" (was {self.value(before, index)})"
            return f"{self.answer.names[index]} {self.value(self.answer, index)}{was}"

        return ", ".join(map(text_of, self.shown))

    @property
    def found(self) -> str:
        """The answer after the view as a short text, such as "bathtub, probability 0.98"."""
        return self.said()

    @property
    def settled_means(self) -> str:
        """The condition under which `settled` counts an answer as reliable, as text."""
        return f"within {100 * _MAX_CHANGE:.0f} % of the view before"

    def settled(self, answers: Sequence[Answer], holds: Holds) -> list[bool]:
        """Return, for each view, whether the answer after it is reliable.

        - `answers`: the answers after all views so far; the last one is `self.answer`.
        - `holds`: see `Holds`.
        """
        return [False, *(np.allclose(now.values, was.values, rtol=_MAX_CHANGE) for was, now in pairwise(answers))]

    def charts(self, answers: Sequence[Answer], truth: Answer | None) -> tuple[Chart, ...]:
        """Return charts of the answers over the views. The last of `answers` is `self.answer`.

        - `truth`: the answer if all of the surface had been seen. None if it is unknown.
        """
        names = self.answer.names
        return (Chart(", ".join(names), names, _rows(answers), None if truth is None else truth.values),)


def _rows(answers: Sequence[Answer]) -> Float[np.ndarray, "views n"]:
    return np.stack([answer.values for answer in answers])


@functools.singledispatch
def words_of(answer: Answer) -> Words:
    """Return the words and charts of an answer."""
    return Words(answer)


@words_of.register(ClassAnswer)
class _ClassWords(Words):
    question = "What is it?"
    rule = Sure()
    settled_means = f"probability {rule.probability} or more, given half of the points too"

    @property
    def shown(self) -> Sequence[int]:
        return np.argsort(-self.answer.values)[:_NUM_CLASSES_NAMED].tolist()

    def value(self, answer: Answer, index: int) -> str:
        return f"{100 * answer.values[index]:.0f} %"

    @property
    def found(self) -> str:
        best = int(np.argmax(self.answer.values))
        name, p = self.answer.names[best], self.answer.values[best]
        return name if p == 1.0 else f"{name}, probability {p:.2f}"

    def settled(self, answers: Sequence[Answer], holds: Holds) -> list[bool]:
        """Return, for each view, whether the class is sure (the stop rule `Sure` holds).

        A view does not count if the view before was sure of a different class.
        """
        is_sure = [holds(self.rule, index) for index in range(len(answers))]
        best = [int(np.argmax(answer.values)) for answer in answers]
        is_contradicted = [False, *(was and a != b for was, (a, b) in zip(is_sure, pairwise(best), strict=False))]
        return [now and not other for now, other in zip(is_sure, is_contradicted, strict=True)]

    def charts(self, answers: Sequence[Answer], truth: Answer | None) -> tuple[Chart, ...]:
        true, goal = None if truth is None else truth.values, self.rule.probability
        return (Chart("probability", self.answer.names, _rows(answers), true, marks_true_name=True, goal=goal),)


@words_of.register(IdentityAnswer)
class _IdentityWords(_ClassWords):
    question = "Which part is it?"
    min_probability = Identified().probability
    settled_means = f"probability {min_probability} or more"

    def settled(self, answers: Sequence[Answer], holds: Holds) -> list[bool]:
        return super().settled(answers, lambda _, index: bool(answers[index].values.max() >= self.min_probability))

    def charts(self, answers: Sequence[Answer], truth: Answer | None) -> tuple[Chart, ...]:
        """Return a chart of the six parts that reached the highest probabilities after any view."""
        values = _rows(answers)
        rows = np.sort(np.argsort(-values.max(axis=0), kind="stable")[:_MAX_PARTS])
        names = tuple(self.answer.names[index] for index in rows)
        return (Chart("probability", names, values[:, rows], goal=self.min_probability),)


@words_of.register(PartAnswer)
class _PartWords(Words):
    answer: PartAnswer
    question = "Which parts does it have?"

    @property
    def shown(self) -> Sequence[int]:
        return self.answer.parts

    def said(self, before: Answer | None = None) -> str:
        return f"points predicted of {super().said(before) or 'no part'}"

    @property
    def found(self) -> str:
        names, values = self.answer.names, self.answer.values
        return ", ".join(names[index] for index in self.shown if values[index] >= self.answer.target) or "no part"

    @property
    def settled_means(self) -> str:
        return f"{self.answer.target:g} points or more of every part"

    def settled(self, answers: Sequence[Answer], holds: Holds) -> list[bool]:
        shown = ((answer, words_of(answer).shown) for answer in answers)
        return [all(answer.values[index] >= self.answer.target for index in indices) for answer, indices in shown]

    def charts(self, answers: Sequence[Answer], truth: Answer | None) -> tuple[Chart, ...]:
        all_answers = answers if truth is None else [*answers, truth]
        parts = sorted({index for answer in all_answers for index in words_of(answer).shown})
        values, target = _rows(answers)[:, parts], self.answer.target
        num_found = np.sum(values >= target, axis=1, keepdims=True).astype(np.float64)
        num_true = None
        if isinstance(truth, PartAnswer):
            num_true = np.array([np.sum(truth.values >= truth.target)], np.float64)
        names = tuple(self.answer.names[index] for index in parts)
        points = Chart("points predicted of each part", names, values, goal=target)
        return Chart(f"parts found ({target:g} points or more)", ("parts",), num_found, num_true), points


@words_of.register(Coldest)
class _ColdestWords(Words):
    answer: Coldest
    question = "Where does it stay coldest while it is heated?"

    def said(self, before: Answer | None = None) -> str:
        was = "" if before is None else f" (was {number_text(float(before.values[0]))})"
        position = point_text(self.answer.point, self.answer.frame)
        return f"coldest at {position}, {number_text(float(self.answer.values[0]))} degrees{was}"

    def charts(self, answers: Sequence[Answer], truth: Answer | None) -> tuple[Chart, ...]:
        """Return charts of the lowest temperature and, given the truth, of the distance from the true point."""
        true = None if truth is None else truth.values
        temperature = Chart("lowest temperature (degrees)", ("coldest",), _rows(answers), true)
        if not isinstance(truth, Coldest):
            return (temperature,)
        frame = self.answer.frame
        points = np.stack([answer.point for answer in answers if isinstance(answer, Coldest)])
        distances = frame.length_to_world(np.linalg.norm(points - truth.point, axis=1))
        label = f"distance to the true coldest point ({frame.unit})"
        return temperature, Chart(label, ("distance",), np.array(distances)[:, None], goal=0.0)


class CoverageAnswer(Answer):
    """How much surface was seen: percent of the true surface, or an area in `unit`."""

    unit: str = "%"

    @property
    def amount(self) -> str:
        """The amount as text, such as "63 %"."""
        value = float(self.values[0])
        return f"{value:.0f} %" if self.unit == "%" else f"{number_text(value)} {self.unit}"


@words_of.register(CoverageAnswer)
class _CoverageWords(Words):
    answer: CoverageAnswer
    question = "What does it look like all round?"

    def said(self, before: Answer | None = None) -> str:
        return f"{self.answer.amount} {self.answer.names[0]}"

    def charts(self, answers: Sequence[Answer], truth: Answer | None) -> tuple[Chart, ...]:
        return (Chart(f"surface seen ({self.answer.unit})", self.answer.names, _rows(answers)),)


def label_of(quantity: Quantity, frame: Frame = Frame()) -> str:  # noqa: B008
    """Return a quantity's name and unit, with lengths in world units, such as "expected new area (m²)"."""
    unit = quantity.unit_in(frame)
    return f"{quantity.name} ({unit})" if unit else quantity.name


def value_text(quantity: Quantity, value: float, frame: Frame) -> str:
    """Return a value in world units as text, with its unit if it is a length or an area."""
    return f"{number_text(value)} {quantity.unit_in(frame)}" if quantity.length_power else number_text(value)


def point_text(point: Float[np.ndarray, "3"], frame: Frame = Frame()) -> str:  # noqa: B008
    """Return a point in scene coordinates as text in world coordinates, "(x, y, z)"."""
    x, y, z = (length_text(coordinate, frame) for coordinate in frame.to_world(np.asarray(point)))
    return f"({x}, {y}, {z})"


def length_text(length: float, frame: Frame) -> str:
    """Return a length in world units as text, with enough decimals to show a hundredth of a scene unit."""
    return f"{length:.{max(0, 2 + math.ceil(math.log10(frame.scale)))}f}".replace("-", "−")


def capital(text: str) -> str:
    """Return the text with its first letter capitalised and the rest unchanged."""
    return text[:1].upper() + text[1:]


def number_text(value: float) -> str:
    """Return a number as text with three significant digits. From 1,000 to 10 million it has no decimals."""
    text = f"{value:,.0f}" if 999.5 <= abs(value) < 1e7 else f"{value:.3g}"
    return text.replace("-", "−")


def kinds_text(kinds: Sequence[tuple[str, float]]) -> str:
    """Return a sentence with the probabilities of the likeliest kinds of known shapes.

    - `kinds`: name and probability of every kind, the likeliest first.
    """
    named = [f"{name} {100 * weight:.0f} %" for name, weight in kinds[:_NUM_KINDS_NAMED]]
    rest = sum(weight for _, weight in kinds[_NUM_KINDS_NAMED:])
    return f"Imagined, as known shapes fit: {', '.join(named)}{f', others {100 * rest:.0f} %' if rest else ''}."
