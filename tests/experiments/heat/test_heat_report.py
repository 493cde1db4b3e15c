"""Tables and the chart of the heat study, from records made by hand."""

import csv

import numpy as np
import pytest
from PIL import Image

from jaxnbv.checks import InputError
from jaxnbv.experiments.heat.figures import write_figures
from jaxnbv.experiments.heat.report import (
    difference_rows,
    halving_rows,
    methods_of,
    quantity_rows,
    saturation_rows,
    summary_table,
    write_tables,
)


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
    return {"same": same, "regret": regret, "seconds": seconds, "evaluations": 192, "full_evaluations": 384}


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


def test_rows_are_means_with_standard_errors():
    rows = {(row["estimate"], row["quantity"], row["method"], row["view"]): row for row in quantity_rows(hand_made())}
    assert len(rows) == 2 * 3 * 2 * 3
    row = rows["all", "distance", "heat", 2]
    # Of 0.4 and 0.6: a standard deviation of 0.1414, over the root of two.
    assert (row["mean"], row["standard_error"], row["scenes"]) == (pytest.approx(0.5), pytest.approx(0.1), 2)
    assert rows["reached", "distance", "heat", 2]["mean"] == pytest.approx(0.4)
    assert rows["all", "point_distance", "heat", 2]["mean"] == pytest.approx(1.5)
    # Temperatures of 0 and 0.1 in place of 0.1: an error is an error above or below.
    assert rows["all", "error", "heat", 3]["mean"] == pytest.approx(0.05)
    assert rows["all", "error", "random", 1]["mean"] == pytest.approx(0.7)


def test_differences_are_paired_and_begin_with_the_first_choice():
    rows = {(row["estimate"], row["quantity"], row["view"]): row for row in difference_rows(hand_made())}
    assert len(rows) == 2 * 3 * 2
    row = rows["all", "distance", 2]
    assert (row["method"], row["baseline"], row["mean"]) == ("heat", "random", pytest.approx(-0.4))
    # Both scenes differ by -0.4, so any resample does; at the third view by -0.4 and -0.2.
    assert (row["low"], row["high"], row["excludes_zero"]) == (pytest.approx(-0.4), pytest.approx(-0.4), True)
    row = rows["reached", "distance", 3]
    assert (row["mean"], row["low"], row["high"]) == tuple(map(pytest.approx, (-0.3, -0.4, -0.2)))
    # Errors of 0.1 and 0.3 less 0.2 and 0.2.
    row = rows["all", "error", 2]
    assert (row["mean"], row["low"], row["excludes_zero"]) == (pytest.approx(0.0), pytest.approx(-0.1), False)
    for record in (records := hand_made()):
        del record["methods"]["random"]
    assert difference_rows(records) == []


def test_steps_without_a_view_of_any_value_are_counted():
    rows = {row["view"]: row for row in saturation_rows(hand_made())}
    assert {row["method"] for row in rows.values()} == {"heat"}
    assert (rows[2]["saturated"], rows[3]["saturated"], rows[3]["scenes"]) == (0.0, 0.5, 2)


def test_searches_are_compared_where_there_was_something_to_find():
    (row,) = halving_rows(hand_made())
    assert (row["steps"], row["open_steps"]) == (4, 3)
    assert row["same_view"] == pytest.approx(2 / 3)
    assert (row["mean_regret"], row["mean_value"]) == (pytest.approx(0.2 / 3), pytest.approx(0.3))
    assert (row["full_seconds"], row["seconds"]) == (11.0, 5.5)
    assert (row["full_evaluations"], row["evaluations"]) == (384, 192)
    for record in (records := hand_made()):
        del record["methods"]["heat"]["halving"]
    assert halving_rows(records) == []
    assert "halving" not in summary_table(records)
    # With no step at which the search had anything to find there is no share to tell.
    records = hand_made()[:1]
    records[0]["methods"]["heat"]["steps"][0]["value"] = 0.0
    assert np.isnan(halving_rows(records)[0]["same_view"])


def test_the_text_and_the_files_hold_the_tables(tmp_path):
    records = hand_made()
    text = summary_table(records)
    lines = [" ".join(line.split()) for line in text.splitlines()]
    assert "heat 1.200 +- 0.200 0.500 +- 0.100 0.300 +- 0.100" in lines
    assert "heat 1.100 +- 0.200 0.400 +- 0.100 0.200 +- 0.100" in lines
    assert "random -0.400 [-0.400, -0.400]* -0.300 [-0.400, -0.200]*" in lines
    assert "heat 0% 50%" in lines
    assert "the same view: 67%" in lines
    assert "imagined scans scored: 192 in place of 384" in lines
    paths = write_tables(records, tmp_path / "tables")
    assert [path.name for path in paths[:2]] == ["results.txt", "results.csv"]
    assert paths[0].read_text() == text
    results, differences, saturation, halving = (list(csv.DictReader(path.open())) for path in paths[1:])
    assert [len(rows) for rows in (results, differences, saturation, halving)] == [36, 12, 2, 1]
    assert halving[0]["same_view"] == "0.666667"
    assert "heat minus" not in summary_table(
        [record | {"methods": {"random": made_run((1,) * 3, (1,) * 3)}} for record in records]
    )


def test_one_scene_has_no_standard_error():
    assert "+- nan" not in summary_table(hand_made()[:1])


def test_records_that_do_not_go_together_are_refused():
    with pytest.raises(InputError, match="no records"):
        methods_of([])
    records = hand_made()
    records[1]["methods"]["heat"]["candidates"] = [3, 1]
    with pytest.raises(InputError, match="number of views"):
        methods_of(records)
    records = hand_made()
    del records[0]["methods"]["heat"], records[1]["methods"]["random"]
    with pytest.raises(InputError, match="in common"):
        methods_of(records)


def test_the_chart_shows_every_method(tmp_path):
    (path,) = write_figures(hand_made(), tmp_path / "figures")
    assert path.name == "coldest.png"
    image = np.asarray(Image.open(path).convert("RGB")).astype(int)
    for colour in ([0xD5, 0x5E, 0x00], [0x7A, 0x84, 0x94]):
        assert (np.abs(image - colour).sum(axis=-1) < 6).sum() > 500
