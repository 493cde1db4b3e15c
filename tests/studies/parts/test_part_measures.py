"""Measures of the part study against times made by hand."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from jaxnbv.studies.parts.discovery import TARGETS, discovery_time
from jaxnbv.studies.parts.study import PartStudy

TIME, _, BY_VIEW = PartStudy.measures


def record(scene=0, views=3, **counts):
    methods = {method.replace("_", "-"): {"views": [], "counts": rows} for method, rows in counts.items()}
    return {"scene": scene, "study_views": views, "methods": methods}


# Two scenes of three views. T_discovery for N_target = 20, 40, 60, 80, 100, with 4 for "not found": discrete 1 2 2 3 3
# and 1 1 1 1 1 (it stopped at once), farthest 2 3 4 4 4 and 3 3 3 3 4.
RECORDS = [
    record(0, discrete=[[25, 39], [60, 70], [100, 120]], farthest=[[0, 90], [20, 90], [59, 95]]),
    record(1, discrete=[[100, 101, 200]], farthest=[[0, 0, 0], [0, 200, 0], [99, 200, 80]]),
]
TIMES = {"discrete": [[1, 2, 2, 3, 3], [1, 1, 1, 1, 1]], "farthest": [[2, 3, 4, 4, 4], [3, 3, 3, 3, 4]]}


def test_discovery_times_by_hand():
    for method, times in TIMES.items():
        for record, expected in zip(RECORDS, times, strict=True):
            assert TIME.compute(record, method) == dict(zip(TARGETS, expected, strict=True))


def test_the_share_by_view_is_of_the_middle_target():
    assert [BY_VIEW.compute(record, "discrete") for record in RECORDS] == [[0, 1, 1], [1, 1, 1]]
    assert [BY_VIEW.compute(record, "farthest") for record in RECORDS] == [[0, 0, 0], [0, 0, 1]]


@given(st.lists(st.lists(st.integers(0, 130), min_size=3, max_size=3), min_size=1, max_size=6), st.integers(1, 120))
def test_discovery_is_the_first_view_with_enough_of_every_part(counts, target):
    time = discovery_time(np.array(counts), target)
    enough = [min(row) >= target for row in counts]
    if time is None:
        assert not any(enough)
    else:
        assert enough[time - 1]
        assert not any(enough[: time - 1])
        # A higher target is not reached sooner, and later views do not matter.
        later = discovery_time(np.array(counts), target + 10)
        assert later is None or later >= time
        assert discovery_time(np.array(counts[:time]), target) == time
