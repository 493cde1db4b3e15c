"""The part study's numbers against tables made by hand."""

import csv

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxnbv.checks import InputError
from jaxnbv.experiments.parts import report as part_report
from jaxnbv.experiments.parts.figures import write_figures
from jaxnbv.experiments.parts.report import (
    difference_rows,
    discovery_times,
    found_share,
    methods_of,
    summary_table,
    time_rows,
    views_of,
    write_tables,
)
from jaxnbv.experiments.parts.study import TARGETS, discovery_time


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
    found = discovery_times(RECORDS, ["farthest", "discrete"])
    np.testing.assert_array_equal(found, np.stack([TIMES["farthest"], TIMES["discrete"]], axis=1))
    np.testing.assert_array_equal(discovery_times(RECORDS[:1], ["discrete"]), [[[1, 2, 2, 3, 3]]])


def test_time_rows_by_hand():
    rows = time_rows(RECORDS)
    assert [(row["method"], row["target"]) for row in rows] == [
        (m, t) for m in ("discrete", "farthest") for t in TARGETS
    ]
    assert [row["mean"] for row in rows] == [1.0, 1.5, 1.5, 2.0, 2.0, 2.5, 3.0, 3.5, 3.5, 4.0]
    assert [row["found"] for row in rows] == [1.0] * 5 + [1.0, 1.0, 0.5, 0.5, 0.0]
    # Of two numbers it is half their difference.
    np.testing.assert_allclose([row["standard_error"] for row in rows], [0, 0.5, 0.5, 1, 1, 0.5, 0, 0.5, 0.5, 0])
    assert [row["rank"] for row in rows] == [1] * 5 + [2] * 5
    assert {row["scenes"] for row in rows} == {2}


def test_equal_means_share_a_rank():
    same = [[100, 100]]
    rows = time_rows([record(discrete=same, farthest=same, random=[[0, 0]], coverage=[[0, 100], [100, 100]])])
    ranks = {row["method"]: row["rank"] for row in rows if row["target"] == 60}
    assert ranks == {"discrete": 1, "farthest": 1, "coverage": 3, "random": 4}
    assert np.isnan([row["standard_error"] for row in rows]).all()


def test_differences_by_hand():
    rows = difference_rows(RECORDS)
    assert [(row["method"], row["baseline"], row["target"]) for row in rows] == [
        ("discrete", "farthest", target) for target in TARGETS
    ]
    scenes = np.subtract(TIMES["discrete"], TIMES["farthest"])
    np.testing.assert_allclose([row["mean"] for row in rows], scenes.mean(axis=0))
    for row, of_scenes in zip(rows, scenes.T, strict=True):
        # With two scenes the bootstrap's ends are the smaller and the greater.
        assert (row["low"], row["high"]) == (of_scenes.min(), of_scenes.max())
        assert row["excludes_zero"]
    tied = difference_rows([*RECORDS, record(2, discrete=[[0]], farthest=[[100]])])
    assert not any(row["excludes_zero"] for row in tied)


def test_without_the_reference_or_another_method_there_is_no_difference():
    assert difference_rows([record(farthest=[[1]], random=[[2]])]) == []
    assert difference_rows([record(discrete=[[1]])]) == []
    assert "minus" not in summary_table([record(discrete=[[1]])])
    assert "minus" in summary_table(RECORDS)


def test_share_found_stays_found_after_an_early_stop():
    share = found_share(RECORDS, ["discrete", "farthest"], 60)
    np.testing.assert_array_equal(share, [[[0, 1, 1], [0, 0, 0]], [[1, 1, 1], [0, 0, 1]]])
    np.testing.assert_array_equal(
        share.mean(axis=2) * 3, 4 - discovery_times(RECORDS, ["discrete", "farthest"])[..., 2]
    )


def test_tables_read_back(tmp_path):
    paths = write_tables(RECORDS, tmp_path / "new" / "folder")
    assert [path.name for path in paths] == ["results.txt", "results.csv", "differences.csv"]
    assert paths[0].read_text(encoding="utf-8") == summary_table(RECORDS)
    for path, rows in ((paths[1], time_rows(RECORDS)), (paths[2], difference_rows(RECORDS))):
        with path.open(newline="", encoding="utf-8") as file:
            read = list(csv.DictReader(file))
        assert len(read) == len(rows)
        for line, row in zip(read, rows, strict=True):
            assert set(line) == set(row)
            for name, value in row.items():
                assert float(line[name]) == pytest.approx(value, abs=1e-6) if type(value) is float else True
                assert line[name] == str(value) or type(value) is float


def test_the_summary_shows_means_errors_shares_and_differences():
    text = summary_table(RECORDS)
    assert "2 scenes" in text
    (line,) = [line for line in text.splitlines() if line.split()[:1] == ["discrete"] and "+-" in line]
    assert " ".join(line.split()[1:5]) == "1.00 +- 0.00** 1.50"
    assert line.split()[-3:] == ["2.00", "+-", "1.00**"]
    (line,) = [line for line in text.splitlines() if line.split()[:1] == ["farthest"] and "%" in line]
    assert line.split()[1:] == ["100%", "100%", "50%", "50%", "0%"]
    assert "-1.50 [-2.00, -1.00]*" in text
    assert "nan" not in summary_table(RECORDS[:1])


def test_records_that_do_not_fit_together_are_refused(tmp_path):
    with pytest.raises(InputError, match="no records"):
        summary_table([])
    with pytest.raises(InputError, match="in common"):
        methods_of([record(discrete=[[1]]), record(random=[[1]])])
    with pytest.raises(InputError, match=r"number of views, \[3, 4\]"):
        write_tables([*RECORDS, record(2, views=4, discrete=[[1]], farthest=[[1]])], tmp_path)
    assert methods_of([*RECORDS, record(2, farthest=[[1]], discrete=[[1]], random=[[1]])]) == ["discrete", "farthest"]
    assert views_of(RECORDS) == 3


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


def test_the_chart_is_drawn(tmp_path):
    (path,) = write_figures(RECORDS, tmp_path / "a")
    assert path == tmp_path / "a" / "parts.png"
    assert path.read_bytes()[:4] == b"\x89PNG"
    (alone,) = write_figures([record(**{method.replace("-", "_"): [[5]] for method in part_report.METHODS})], tmp_path)
    assert alone.read_bytes() != path.read_bytes()
    with pytest.raises(InputError, match="no records"):
        write_figures([], tmp_path)
