"""What the heat study measures, from records made by hand."""

import pytest
from jaxnbv.studies.engine.charts import write_charts
from jaxnbv.studies.engine.tables import summary, write_tables

from jaxnbv.studies.engine.results import differences, means
from jaxnbv.studies.heat.study import HeatStudy


def made_run(distances, temperatures, values=(0.5, 0.0), halving=None):
    """Estimates among warmed points are a tenth nearer, and as warm."""
    estimates = {
        name: {
            "distances": [distance - less for distance in distances],
            "point_distances": [distance + 1.0 - less for distance in distances],
            "temperatures": list(temperatures),
            "points": [[0.0, 0.0, 0.0]] * len(distances),
        }
        for name, less in (("all", 0.0), ("reached", 0.1))
    }
    steps = [{"value": value, "seconds": 10.0 + 2.0 * index} for index, value in enumerate(values)]
    run = {"candidates": [3, 1, 2], "reached": [1.0, 1.0, 0.9], "steps": steps, "estimates": estimates}
    return run if halving is None else run | {"halving": halving}


def asked(same, regret, seconds):
    return {"same": same, "regret": regret, "seconds": seconds}


def hand_made():
    def record(scene, **methods):
        truth = {"point": [0.0, 0.0, 0.0], "temperature": 0.1, "hottest": 0.4}
        return {"scene": scene, "name": "desk", "first": 3, "truth": truth, "methods": methods, "seconds": 1.0}

    return [
        record(
            0,
            random=made_run((1.0, 0.8, 0.6), (0.9, 0.3, 0.2), (0.7, 0.2)),
            heat=made_run((1.0, 0.4, 0.2), (0.9, 0.2, 0.0), halving=[asked(False, 0.2, 4.0), asked(True, 0.0, 5.0)]),
        ),
        record(
            1,
            random=made_run((1.4, 1.0, 0.6), (0.7, 0.3, 0.2), (0.7, 0.2)),
            heat=made_run((1.4, 0.6, 0.4), (0.7, 0.4, 0.1), (0.3, 0.1), [asked(True, 0.0, 6.0), asked(True, 0.0, 7.0)]),
        ),
    ]


def rows_of(records, *names):
    found = means(records, ["heat", "random"], [HeatStudy.measure(name) for name in names])
    return {(row["quantity"], row["method"], row["at"]): row for row in found.to_dict("records")}


def test_measures_are_of_the_estimates():
    names = [measure.name for measure in HeatStudy.measures]
    rows = rows_of(hand_made(), *names)
    row = rows["distance, all", "heat", 2]
    # Of 0.4 and 0.6: a standard deviation of 0.1414, over the root of two.
    assert (row["mean"], row["standard_error"], row["scenes"]) == (pytest.approx(0.5), pytest.approx(0.1), 2)
    assert rows["distance, reached", "heat", 2]["mean"] == pytest.approx(0.4)
    assert rows["point distance, all", "heat", 2]["mean"] == pytest.approx(1.5)
    # Temperatures of 0 and 0.1 in place of 0.1: an error is an error above or below.
    assert rows["error, all", "heat", 3]["mean"] == pytest.approx(0.05)
    assert rows["error, all", "random", 1]["mean"] == pytest.approx(0.7)


def test_differences_begin_with_the_first_choice():
    distances = [HeatStudy.measure("distance, all"), HeatStudy.measure("distance, reached")]
    found = differences(hand_made(), ["heat", "random"], distances, "heat")
    assert len(found) == 4
    rows = found.set_index(["quantity", "at"]).loc
    row = rows["distance, all", 2]
    # Both scenes differ by -0.4, so any resample does; at the third view by -0.4 and -0.2.
    assert (row["mean"], row["low"], row["high"], row["excludes_zero"]) == (*[pytest.approx(-0.4)] * 3, True)
    row = rows["distance, reached", 3]
    assert (row["mean"], row["low"], row["high"]) == tuple(map(pytest.approx, (-0.3, -0.4, -0.2)))


def test_steps_without_a_view_of_any_value_are_counted_where_cold_is_sought():
    rows = rows_of(hand_made(), "saturated")
    assert {method for _, method, _ in rows} == {"heat"}
    saturated = [rows["saturated", "heat", view] for view in (2, 3)]
    assert [(row["mean"], row["scenes"]) for row in saturated] == [(0.0, 2), (0.5, 2)]


def test_searches_are_compared_where_there_was_something_to_find():
    rows = rows_of(hand_made(), "same", "regret", "seconds")
    same = [rows["same", "heat", view] for view in (2, 3)]
    # At the last view of the first scene no candidate had a value.
    assert [(row["mean"], row["scenes"]) for row in same] == [(0.5, 2), (1.0, 1)]
    assert rows["regret", "heat", 2]["mean"] == pytest.approx(0.1)
    assert rows["seconds", "heat", "median"]["mean"] == 11.0
    for record in (records := hand_made()):
        del record["methods"]["heat"]["halving"]
    assert "alving" not in summary(records, HeatStudy)


def test_the_text_and_the_files_hold_the_tables(tmp_path):
    records = hand_made()
    text = summary(records, HeatStudy)
    lines = [" ".join(line.split()) for line in text.splitlines()]
    assert "heat 1.200 +- 0.200** 0.500 +- 0.100** 0.300 +- 0.100**" in lines
    assert "random -0.400 [-0.400, -0.400]* -0.300 [-0.400, -0.200]*" in lines
    assert "heat 0.00 (2) 0.50 (2)" in lines
    assert max(map(len, text.splitlines())) <= 120
    paths = write_tables(records, HeatStudy, tmp_path)
    assert [path.name for path in paths] == ["results.txt", "results.csv", "differences.csv"]
    assert [path.name for path in write_charts(records, HeatStudy, tmp_path)] == ["coldest.png"]
