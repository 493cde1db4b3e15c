"""Hits on hand-made sequences; random search against every order there is."""

import itertools

import numpy as np
import pytest

from jaxnbv.checks import InputError
from jaxnbv.studies.classification.measures import first_hits, random_seen_share, stable_hits
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


def test_the_pattern_is_seen_in_one_view_not_in_their_sum():
    runs = [{"pattern_pixels": pixels} for pixels in ([0, 100, 100, 150, 0], [0, 149, 149, 149, 149])]
    record = {"methods": {"farthest": {"runs": runs}}}
    np.testing.assert_array_equal(PyramidStudy.measure("pattern").of(record, "farthest"), [0.0, 0.0, 0.0, 0.5, 0.5])


@pytest.mark.parametrize("showing", range(7))
@pytest.mark.parametrize("first_shows", [False, True])
def test_random_search_agrees_with_all_orders(showing, first_shows):
    first, views = 3, 7
    others = [i for i in range(7) if i != first]
    pixels = np.full(7, 149)
    pixels[others[:showing]] = 150
    pixels[first] = 150 if first_shows else 0
    orders = [(first, *order) for order in itertools.permutations(others)]
    shown = np.array([np.maximum.accumulate(pixels[list(order)] >= 150) for order in orders])
    np.testing.assert_allclose(random_seen_share(pixels, first, views), shown.mean(axis=0), atol=1e-14)


def test_random_search_over_one_view_and_bad_input():
    pixels = np.array([0, 200, 0])
    np.testing.assert_array_equal(random_seen_share(pixels, 0, 1), [0.0])
    np.testing.assert_array_equal(random_seen_share(np.array([0, 149, 0]), 0, 2), [0.0, 0.0])
    with pytest.raises(InputError, match="4 views of 3 candidates"):
        random_seen_share(pixels, 0, 4)
    with pytest.raises(InputError, match="candidate 3 of 3"):
        random_seen_share(pixels, 3, 2)
