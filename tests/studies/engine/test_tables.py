"""Tables: errors of means, aligned text and CSV."""

import csv
import math

import pytest

from jaxnbv.studies.engine.tables import count_of, text_grid, underlined, write_csv


def test_text_is_aligned_to_the_right_under_its_columns():
    cells = {
        ("first", "20"): "1.5",
        ("first", "a column"): "12.25 ",
        ("second", "20"): "3",
        ("second", "a column"): "4",
    }
    text = text_grid("corner", ["first", "second"], ["20", "a column"], cells)
    lines = text.splitlines()
    assert [line.split() for line in lines] == [
        ["corner", "20", "a", "column"],
        ["first", "1.5", "12.25"],
        ["second", "3", "4"],
    ]
    assert lines[0].index("20") + 2 == lines[1].index("1.5") + 3 == lines[2].index("3") + 1
    assert lines[0].index("a column") + 8 == lines[2].index("4") + 1
    assert not any(line != line.rstrip() for line in lines)
    assert text.endswith("\n")


def test_titles_and_counts():
    assert underlined("Views") == "Views\n=====\n"
    assert [count_of(n, "scene") for n in (0, 1, 2)] == ["0 scenes", "1 scene", "2 scenes"]


def test_csv_rounds_floats_and_nothing_else(tmp_path):
    rows = [{"name": "a,b", "mean": 0.12345678, "count": 3}, {"name": 'say "é"', "mean": math.nan, "count": 4}]
    path = write_csv(tmp_path / "rows.csv", rows, ("name", "mean", "count"))
    with path.open(newline="", encoding="utf-8") as file:
        read = list(csv.DictReader(file))
    assert read == [
        {"name": "a,b", "mean": "0.123457", "count": "3"},
        {"name": 'say "é"', "mean": "nan", "count": "4"},
    ]
    with pytest.raises(ValueError, match="extra"):
        write_csv(tmp_path / "wrong.csv", [{"name": "a", "extra": 1}], ("name",))
