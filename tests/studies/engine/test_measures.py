"""Numbers of hand-made records: means, errors, intervals, differences; tables and charts of them."""

import csv

import numpy as np
import pandas as pd
import pytest
from jaxnbv.studies.engine.charts import write_charts
from jaxnbv.studies.engine.tables import summary, write_tables
from PIL import Image
from toy import ToyStudy

from jaxnbv.checks import InputError
from jaxnbv.studies.engine.measures import Measure, methods_of, values
from jaxnbv.studies.engine.results import differences, means

POINTS, MANY, ODD = ToyStudy.measures
BOTH = ["farthest", "random"]


def record(scene, **methods):
    return {
        "scene": scene,
        "methods": {name: made if isinstance(made, dict) else {"points": made} for name, made in methods.items()},
    }


def rows_of(records, methods, measures):
    return means(records, methods, measures).to_dict("records")


RECORDS = [
    record(0, random=[1000, 2000, 2500], farthest=[1000, 3500, 4000]),
    record(1, random={"points": [800, 2600, 3100], "odd": [0.5]}, farthest=[800, 3100, 5000]),
]


def test_rows_are_means_with_errors_intervals_and_ranks():
    rows = {(row["quantity"], row["at"], row["method"]): row for row in rows_of(RECORDS, BOTH, [POINTS, MANY])}
    assert len(rows) == 2 * 3 * 2
    row = rows["points", 2, "farthest"]
    # Of 3,500 and 3,100: a standard deviation of 400 / sqrt(2), over sqrt(2).
    assert (row["mean"], row["standard_error"], row["scenes"], row["by"]) == (3300.0, pytest.approx(200.0), 2, "view")
    # Four resamples of two scenes, a quarter of them each scene twice.
    assert (row["low"], row["high"]) == (3100.0, 3500.0)
    assert (row["rank"], rows["points", 2, "random"]["rank"]) == (1, 2)
    assert {rows["points", 1, method]["rank"] for method in ("farthest", "random")} == {1}
    assert rows["many", 3, "random"]["mean"] == 0.5
    assert pd.isna(rows["many", 3, "random"]["rank"])


def test_less_can_be_better():
    less = POINTS._replace(better="less")
    ranks = {row["method"]: row["rank"] for row in rows_of(RECORDS, BOTH, [less]) if row["at"] == 3}
    assert ranks == {"farthest": 2, "random": 1}


def test_differences_are_paired_and_leave_out_the_view_that_all_share():
    rows = differences(RECORDS, BOTH, [POINTS], "farthest")
    assert [*rows["at"]] == [2, 3]
    first = rows.iloc[0]
    assert (first["method"], first["baseline"], first["mean"]) == ("farthest", "random", 1000.0)
    assert (first["low"], first["high"], first["excludes_zero"]) == (500.0, 1500.0, True)
    assert differences(RECORDS, ["random"], [POINTS], "farthest").empty
    assert differences(RECORDS, ["farthest"], [POINTS], "farthest").empty
    # Columns that are not views have no shared one.
    by_size = POINTS._replace(columns=("s", "m", "l"), by="size")
    assert [*differences(RECORDS, BOTH, [by_size], "farthest")["at"]] == ["s", "m", "l"]


def test_scenes_without_a_value_are_left_out_of_a_column():
    gaps = Measure("gaps", "Gaps", lambda r, m: [1.0, None if r["scene"] == 0 and m == "random" else 2.0 + r["scene"]])
    np.testing.assert_array_equal(values(RECORDS, ["random"], gaps), [[[1.0, np.nan]], [[1.0, 3.0]]])
    rows = {(row["at"], row["method"]): row for row in rows_of(RECORDS, BOTH, [gaps])}
    assert [rows[1, method]["scenes"] for method in ("farthest", "random")] == [2, 2]
    # Compared over the scene that both have.
    assert [(rows[2, method]["scenes"], rows[2, method]["mean"]) for method in ("farthest", "random")] == [
        (1, 3.0),
        (1, 3.0),
    ]
    (alone,) = rows_of(RECORDS, BOTH, [ODD])
    assert [alone[key] for key in ("method", "at", "mean", "scenes")] == ["random", "once", 0.5, 1]
    assert np.isnan(alone["low"])
    nothing = gaps._replace(of=lambda r, m: [None])
    assert means(RECORDS, ["random"], [nothing]).empty
    assert differences(RECORDS, BOTH, [nothing], "farthest").empty


def test_methods_that_all_records_hold_come_in_order_with_ones_own_last():
    assert methods_of(RECORDS, ("farthest", "best", "random")) == BOTH
    mine = [record(0, mine=[1], random=[1], farthest=[1]), record(1, farthest=[1], mine=[1])]
    assert methods_of(mine, ToyStudy.methods) == ["farthest", "mine"]
    with pytest.raises(InputError, match="no records"):
        methods_of([], ToyStudy.methods)
    with pytest.raises(InputError, match="in common"):
        methods_of([record(0, random=[1]), record(1, farthest=[1])], ToyStudy.methods)


def test_records_of_other_lengths_are_refused(tmp_path):
    records = [*RECORDS, record(2, random=[1, 2], farthest=[1, 2])]
    for write in (write_tables, write_charts):
        with pytest.raises(InputError, match=r"number of views, \[2, 3\]"):
            write(records, ToyStudy, tmp_path)
        with pytest.raises(InputError, match="no records"):
            write([], ToyStudy, tmp_path)


def test_the_text_and_the_files_hold_the_tables(tmp_path):
    paths = write_tables(RECORDS, ToyStudy, tmp_path / "new" / "tables")
    assert [path.name for path in paths] == ["results.txt", "results.csv", "differences.csv"]
    text = paths[0].read_text(encoding="utf-8")
    assert text == summary(RECORDS, ToyStudy)
    assert "Points of a ball: 2 scenes" in text
    lines = [" ".join(line.split()) for line in text.splitlines()]
    assert "farthest 900.0 +- 100.0** 3300.0 +- 200.0** 4500.0 +- 500.0**" in lines
    assert "random 900.0 +- 100.0** 2300.0 +- 300.0* 2800.0 +- 300.0*" in lines
    assert "random +1000.0 [+500.0, +1500.0]* +1700.0 [+1500.0, +1900.0]*" in lines
    assert "random 0 [0, 0] 0 [0, 0] 50 [0, 100]" in lines
    assert "random +100 [+100, +100]* +50 [+0, +100]" in lines
    assert "random 0.500 (1)" in lines
    assert "even: 1 scene" in text
    assert "even" not in summary(RECORDS, ToyStudy, groups=False)
    assert "nan" not in text
    results, differences = (list(csv.DictReader(path.open(newline=""))) for path in paths[1:])
    assert {row["group"] for row in results} == {"all", "even", "odd"}
    (row,) = [
        row
        for row in results
        if (row["group"], row["quantity"], row["at"], row["method"]) == ("odd", "points", "2", "random")
    ]
    assert (row["mean"], row["standard_error"], row["scenes"]) == ("2600.0", "", "1")
    assert len(differences) == 3 * (2 + 2)


@pytest.mark.parametrize("scenes", [1, 2])
def test_charts_show_every_method(tmp_path, scenes):
    paths = write_charts(RECORDS[:scenes], ToyStudy, tmp_path / "charts")
    assert [path.name for path in paths] == ["points.png", "halves.png"]
    for path in paths:
        image = np.asarray(Image.open(path).convert("RGB")).astype(int)
        for colour in ([0x00, 0x72, 0xB2], [0x7A, 0x84, 0x94]):
            assert (np.abs(image - colour).sum(axis=-1) < 6).sum() > 200


def test_a_chart_of_nothing_is_not_drawn(tmp_path):
    records = [record(0, mine={"points": []}), record(1, mine={"points": []})]
    assert write_charts(records, ToyStudy, tmp_path) == []
