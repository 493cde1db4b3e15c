"""Hit times on hand-made sequences; random search against every order there is."""

import itertools

import numpy as np
import pytest

from jaxnbv.checks import InputError
from jaxnbv.studies.classification.measures import cumulative_share, first_hit, random_seen_share, seen_view, stable_hit


@pytest.mark.parametrize(
    ("correct", "first", "stable"),
    [
        ("00000", None, None),
        ("11111", 1, 1),
        ("01111", 2, 2),
        ("01011", 2, 4),
        ("11110", 1, None),
        ("00001", 5, 5),
        ("0", None, None),
        ("1", 1, 1),
    ],
)
def test_hit_times_of_hand_made_sequences(correct, first, stable):
    correct = np.array([letter == "1" for letter in correct])
    assert first_hit(correct) == first
    assert stable_hit(correct) == stable


def test_the_pattern_is_seen_in_one_view_not_in_their_sum():
    assert seen_view(np.array([0, 100, 100, 150, 0])) == 4
    assert seen_view(np.array([0, 149, 149])) is None
    assert seen_view(np.array([0, 149, 149]), threshold=149) == 2


def test_sequences_that_never_hit_count_in_the_whole():
    np.testing.assert_allclose(cumulative_share([2, None, 3, 2], 4), [0.0, 0.5, 0.75, 0.75])
    np.testing.assert_array_equal(cumulative_share([None], 3), [0.0, 0.0, 0.0])
    with pytest.raises(InputError, match="no sequences"):
        cumulative_share([], 3)


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
    np.testing.assert_array_equal(random_seen_share(pixels, 0, 2, threshold=201), [0.0, 0.0])
    with pytest.raises(InputError, match="4 views of 3 candidates"):
        random_seen_share(pixels, 0, 4)
    with pytest.raises(InputError, match="candidate 3 of 3"):
        random_seen_share(pixels, 3, 2)
