"""What the part study measures, against times made by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jaxnbv.studies.engine.charts import write_charts
from jaxnbv.studies.engine.tables import summary

from jaxnbv.checks import InputError
from jaxnbv.studies.engine.measures import values
from jaxnbv.studies.engine.results import differences, means
from jaxnbv.studies.parts.discovery import TARGETS, discovery_time
from jaxnbv.studies.parts.study import PartStudy

TIME, FOUND, BY_VIEW = PartStudy.measures


def record(scene=0, views=3, **counts):
    methods = {method.replace("_", "-"): {"views": [], "counts": rows} for method, rows in counts.items()}
    return {"scene": scene, "study_views": views, "methods": methods}


# Two scenes of three views. T_discovery by N_target = 20, 40, 60, 80, 100, with 4 for "not found":
# discrete 1 2 2 3 3 and 1 1 1 1 1 (it stopped at once), farthest 2 3 4 4 4 and 3 3 3 3 4.
RECORDS = [
    record(0, discrete=[[25, 39], [60, 70], [100, 120]], farthest=[[0, 90], [20, 90], [59, 95]]),
    record(1, discrete=[[100, 101, 200]], farthest=[[0, 0, 0], [0, 200, 0], [99, 200, 80]]),
]
TIMES = {"discrete": [[1, 2, 2, 3, 3], [1, 1, 1, 1, 1]], "farthest": [[2, 3, 4, 4, 4], [3, 3, 3, 3, 4]]}


def test_discovery_times_by_hand():
    found = values(RECORDS, ["farthest", "discrete"], TIME)
    np.testing.assert_array_equal(found, np.stack([TIMES["farthest"], TIMES["discrete"]], axis=1))


def test_rows_by_hand():
    rows = means(RECORDS, [*TIMES], [TIME, FOUND]).set_index(["quantity", "method", "at"])
    every = [(method, target) for method in TIMES for target in TARGETS]
    of_time, of_share = ([rows.loc[name, *of] for of in every] for name in ("time", "found"))
    assert [row["mean"] for row in of_time] == [1.0, 1.5, 1.5, 2.0, 2.0, 2.5, 3.0, 3.5, 3.5, 4.0]
    assert [row["mean"] for row in of_share] == [1.0] * 5 + [1.0, 1.0, 0.5, 0.5, 0.0]
    # Of two numbers it is half their difference.
    errors = [row["standard_error"] for row in of_time]
    np.testing.assert_allclose(errors, [0, 0.5, 0.5, 1, 1, 0.5, 0, 0.5, 0.5, 0])
    assert [row["rank"] for row in of_time] == [1] * 5 + [2] * 5


def test_differences_are_of_all_targets():
    rows = differences(RECORDS, [*TIMES], [TIME], "discrete")
    assert [*rows["at"]] == list(TARGETS)
    assert [*rows["mean"]] == [-1.5, -1.5, -2.0, -1.5, -2.0]


def test_the_share_by_view_is_of_the_middle_target():
    found = values(RECORDS, ["discrete", "farthest"], BY_VIEW)
    np.testing.assert_array_equal(found, [[[0, 1, 1], [0, 0, 0]], [[1, 1, 1], [0, 0, 1]]])


def test_the_summary_shows_means_errors_shares_and_differences(tmp_path):
    text = summary(RECORDS, PartStudy)
    lines = [" ".join(line.split()) for line in text.splitlines()]
    assert "discrete 1.00 +- 0.00** 1.50 +- 0.50** 1.50 +- 0.50** 2.00 +- 1.00** 2.00 +- 1.00**" in lines
    assert "farthest 100 [100, 100] 100 [100, 100] 50 [0, 100] 50 [0, 100] 0 [0, 0]" in lines
    assert "-1.50 [-2.00, -1.00]*" in text
    assert [path.name for path in write_charts(RECORDS, PartStudy, tmp_path)] == ["parts.png"]
    with pytest.raises(InputError, match=r"number of views, \[3, 4\]"):
        summary([*RECORDS, record(2, views=4, discrete=[[1]], farthest=[[1]])], PartStudy)


@given(st.lists(st.lists(st.integers(0, 130), min_size=3, max_size=3), min_size=1, max_size=6), st.integers(1, 120))
def test_discovery_is_the_first_view_with_enough_of_every_part(counts, target):
    found = discovery_time(np.array(counts), target)
    enough = [min(row) >= target for row in counts]
    if found is None:
        assert not any(enough)
    else:
        assert enough[found - 1]
        assert not any(enough[: found - 1])
        # More points asked for are not found sooner, and what follows does not matter.
        later = discovery_time(np.array(counts), target + 10)
        assert later is None or later >= found
        assert discovery_time(np.array(counts[:found]), target) == found
