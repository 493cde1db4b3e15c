"""Hits on hand-made sequences."""

import numpy as np
import pytest

from jaxnbv.studies.classification.measures import first_hits, stable_hits
from jaxnbv.studies.classification.objects import PyramidStudy


@pytest.mark.parametrize(
    ("correct", "first", "stable"),
    [
        ("00000", "00000", "00000"),
        ("11111", "11111", "11111"),
        ("01111", "01111", "01111"),
        ("01011", "01111", "00011"),
        ("11110", "11111", "00000"),
        ("00001", "00001", "00001"),
        ("0", "0", "0"),
        ("1", "1", "1"),
    ],
)
def test_hits_by_view_of_hand_made_sequences(correct, first, stable):
    correct, first, stable = (np.array([[letter == "1" for letter in word]]) for word in (correct, first, stable))
    np.testing.assert_array_equal(first_hits(correct), first)
    np.testing.assert_array_equal(stable_hits(correct), stable)
    # Each sequence by itself.
    np.testing.assert_array_equal(first_hits(np.concatenate([correct, ~correct]))[:1], first)
    np.testing.assert_array_equal(stable_hits(np.concatenate([~correct, correct]))[1:], stable)


def run(*guesses):
    return np.log(0.1 + 0.5 * np.eye(5)[np.array(guesses)]).tolist()


def made(method, log_p, pixels):
    noted = {"rank_correlation": [None, 0.5, None], "roughness": [None, 1.0, 3.0]}
    steps = [{"value": 2.0, "seconds": 9.0}, {"value": 1.0, "seconds": 0.3}, {"value": 1.0, "seconds": 0.1}]
    return {"scene": 0, "label": 1, "methods": {method: {"log_p": log_p, "pixels": pixels, "steps": steps, **noted}}}


def measured(record, name):
    (measure,) = (one for one in PyramidStudy.measures if one.name == name)
    (method,) = record["methods"]
    return measure.of(record, method)


def test_measures_of_a_hand_made_record():
    """Of random search they are means over its runs; the pattern is seen in one view, not in their sum."""
    record = made("random", [run(0, 1, 0), run(0, 0, 1)], [[0, 149, 149], [0, 150, 0]])
    np.testing.assert_array_equal(measured(record, "first"), [0.0, 0.5, 1.0])
    np.testing.assert_array_equal(measured(record, "stable"), [0.0, 0.0, 0.5])
    np.testing.assert_array_equal(measured(record, "seen"), [0.0, 0.5, 0.5])
    assert measured(record, "rank_correlation") == [None, 0.5, None]
    # The value of random search is no cross-entropy.
    assert measured(record, "value") == {}
    assert measured(record, "seconds") == {"median": pytest.approx(0.2)}
    hybrid = made("hybrid", [run(0, 1, 1)], [])
    assert measured(hybrid, "value") == {2: 2.0, 3: 1.0, 4: 1.0}
    assert measured(hybrid, "seen") == []


@pytest.mark.parametrize(("angle", "least"), [(80.0, "000"), (110.0, "110"), (139.9, "110"), (179.0, "140")])
def test_pyramids_are_told_apart_by_the_angle_of_the_first_view(angle, least):
    assert PyramidStudy.group({"angle": angle}) == f"first view at {least}° or more from the base's normal"
