"""Curves, tables and files of the pyramid study, from records made by hand."""

import csv
import json
import re

import numpy as np
import pytest
from PIL import Image

from jaxnbv.checks import InputError
from jaxnbv.experiments.pyramid.figures import write_figures
from jaxnbv.experiments.pyramid.pictures import write_pictures
from jaxnbv.experiments.pyramid.report import METHODS, curves, methods_of, summary_table, write_tables


def log_p(guesses):
    """Log-probabilities of a sequence of predicted classes."""
    return np.log(0.1 + 0.5 * np.eye(5)[guesses]).tolist()


def run(guesses, pixels):
    return {"candidates": list(range(len(guesses))), "pattern_pixels": pixels, "log_p": log_p(guesses)}


def record(scene, methods, label=1, angle=100.0, framing="close-up", random_hit=0.25, diagnostics=()):
    pixels = [0, 200, 0, 200, 0, 0, 0, 0, 0]
    return {
        "scene": scene,
        "framing": framing,
        "split": "test",
        "label": label,
        "first": 0,
        "angle": angle,
        "pattern_pixels": pixels,
        "random_hit": random_hit,
        "methods": {name: {"runs": runs} for name, runs in methods.items()},
        "diagnostics": list(diagnostics),
        "seconds": 1.0,
    }


def synthetic_records(scenes, views=5, methods=METHODS, framing="close-up", seed=0):
    """Random records which hold together: candidates differ, pixels are those of the candidates."""
    rng = np.random.default_rng(seed)
    records = []
    for scene in range(scenes):
        pixels = np.where(rng.uniform(size=12) < 0.3, rng.integers(1, 900, 12), 0)
        pixels[0] = 0

        def sequence(pixels=pixels):
            candidates = [0, *(1 + rng.permutation(11))[: views - 1].tolist()]
            answers = np.log(rng.dirichlet(np.ones(5), views)).tolist()
            return {"candidates": candidates, "pattern_pixels": pixels[candidates].tolist(), "log_p": answers}

        runs = {name: [sequence() for _ in range(3 if name == "random" else 1)] for name in methods}
        first = runs[methods[0]][0]["log_p"][0]
        for of_method in runs.values():
            for one in of_method:
                one["log_p"][0] = first
        correlations = {name: float(rng.uniform(-1, 1)) for name in methods if name != "random"}
        entry = {"roughness": 2.0, "near_sensor": None, "rank_correlation": correlations}
        diagnostics = [entry | {"view": view, "methods": list(correlations)} for view in range(2, views + 1)]
        angle, hit = float(rng.uniform(80, 180)), float(rng.uniform())
        made = record(scene, runs, scene % 5, angle, framing, hit, diagnostics if correlations else [])
        records.append(json.loads(json.dumps(made | {"pattern_pixels": pixels.tolist()})))
    return records


def two_scenes():
    """Cross-entropy hits at view 2 and stays; farthest never sees the pattern, and hits once or never."""
    ours = run([0, 1, 1], [0, 200, 0])
    random = [run([0, 1, 0], [0, 0, 0]), run([0, 0, 1], [0, 0, 0])]
    diagnostics = [
        {"view": 2, "methods": ["cross-entropy", "farthest"], "roughness": 1.0, "near_sensor": None}
        | {"rank_correlation": {"cross-entropy": 0.5, "farthest": -0.5}},
        {"view": 3, "methods": ["cross-entropy"], "roughness": 3.0, "near_sensor": 0.25}
        | {"rank_correlation": {"cross-entropy": None}},
    ]
    farthest = run([0, 1, 0], [0, 0, 149]), run([0, 2, 2], [0, 0, 0])
    return [
        record(
            7,
            {"cross-entropy": [ours], "farthest": [farthest[0]], "random": random},
            angle=100.0,
            diagnostics=diagnostics,
        ),
        record(3, {"cross-entropy": [ours], "farthest": [farthest[1]], "random": random}, angle=175.0),
    ]


def test_curves_of_hand_made_sequences():
    records = two_scenes()
    np.testing.assert_array_equal(curves(records, "cross-entropy", "first"), [[0, 1, 1], [0, 1, 1]])
    np.testing.assert_array_equal(curves(records, "cross-entropy", "stable"), [[0, 1, 1], [0, 1, 1]])
    np.testing.assert_array_equal(curves(records, "cross-entropy", "pattern"), [[0, 1, 1], [0, 1, 1]])
    np.testing.assert_array_equal(curves(records, "farthest", "first"), [[0, 1, 1], [0, 0, 0]])
    np.testing.assert_array_equal(curves(records, "farthest", "stable"), np.zeros((2, 3)))
    np.testing.assert_array_equal(curves(records, "farthest", "pattern"), np.zeros((2, 3)))


def test_random_search_is_exact_where_it_can_be():
    records = two_scenes()
    # Two of eight candidates show the pattern.
    exact = [0.0, 2 / 8, 1 - (6 / 8) * (5 / 7)]
    np.testing.assert_allclose(curves(records, "random", "pattern"), [exact, exact])
    # By view 2 half of the runs hit, but the expectation over all candidates is 0.25.
    np.testing.assert_allclose(curves(records, "random", "first"), [[0, 0.25, 1], [0, 0.25, 1]])
    np.testing.assert_allclose(curves(records, "random", "stable"), [[0, 0, 0.5], [0, 0, 0.5]])
    already = record(0, {"random": [run([1, 0, 0], [0, 0, 0])]}, random_hit=0.25)
    np.testing.assert_allclose(curves([already], "random", "first"), [[1, 1, 1]])


def test_curves_only_rise_and_stable_hits_follow_first_hits():
    records = synthetic_records(30)
    for method in set(METHODS) - {"random"}:
        first, stable, pattern = (curves(records, method, quantity) for quantity in ("first", "stable", "pattern"))
        for values in (first, stable, pattern):
            assert (np.diff(values, axis=1) >= 0).all()
        assert (stable <= first).all()
        right = [np.argmax(r["methods"][method]["runs"][0]["log_p"][-1]) == r["label"] for r in records]
        np.testing.assert_array_equal(stable[:, -1], right)


def read(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def only(rows, **wanted):
    (row,) = (row for row in rows if wanted.items() <= row.items())
    return row


def test_tables_hold_shares_computed_by_hand(tmp_path):
    records = two_scenes()
    paths = write_tables(records, tmp_path / "new")
    assert [path.name for path in paths] == ["results.txt", "results.csv", "differences.csv", "diagnostics.csv"]
    results, differences, diagnostics = (read(path) for path in paths[1:])

    row = only(results, angle="all", quantity="first", method="farthest", view="2")
    assert (row["framing"], float(row["mean"]), row["scenes"]) == ("close-up", 0.5, "2")
    assert (float(row["low"]), float(row["high"])) == (0.0, 1.0)
    row = only(results, angle="140-180", quantity="first", method="farthest", view="2")
    assert (float(row["mean"]), float(row["high"]), row["scenes"]) == (0.0, 0.0, "1")
    row = only(results, angle="all", quantity="pattern", method="random", view="3")
    assert float(row["mean"]) == pytest.approx(1 - 30 / 56, abs=1e-6)
    assert {row["angle"] for row in results} == {"all", "under 110", "140-180"}
    assert len(results) == 3 * 3 * 3 * 3

    row = only(differences, angle="all", quantity="first", baseline="farthest", view="2")
    assert (float(row["mean"]), row["excludes_zero"]) == (0.5, "False")
    row = only(differences, angle="all", quantity="stable", baseline="farthest", view="3")
    assert (float(row["mean"]), float(row["low"]), row["excludes_zero"]) == (1.0, 1.0, "True")
    assert {row["baseline"] for row in differences} == {"farthest", "random"}

    row = only(diagnostics, angle="all", quantity="rank_correlation", method="farthest", view="2")
    assert (float(row["mean"]), row["scenes"]) == (-0.5, "1")
    row = only(diagnostics, angle="all", quantity="roughness", method="cross-entropy", view="3")
    assert float(row["mean"]) == 3.0
    missing = {("rank_correlation", "3"), ("near_sensor", "2")}
    assert not missing & {(row["quantity"], row["view"]) for row in diagnostics}
    assert not [row for row in diagnostics if row["method"] == "farthest" and row["view"] == "3"]

    text = paths[0].read_text(encoding="utf-8")
    assert text == summary_table(records)
    assert "close-up, all angles: 2 scenes" in text
    assert "close-up, angle 140-180: 1 scene\n" in text
    head, *lines = text.split("first hit\n")[1].splitlines()[:4]
    assert head.split() == ["view", "1", "view", "2", "view", "3"]
    assert lines[1].split()[0] == "farthest"
    assert re.findall(r"\d+", lines[1]) == ["0", "0", "0", "50", "0", "100", "50", "0", "100"]
    compared = text.split("stable hit: cross-entropy minus")[1].splitlines()[2]
    assert compared.split() == ["farthest", "+100", "[+100,", "+100]*", "+100", "[+100,", "+100]*"]
    assert max(map(len, text.splitlines())) <= 120


def test_framings_are_told_apart(tmp_path):
    hit, miss = run([1, 1], [0, 0]), run([0, 0], [0, 0])
    records = [record(0, {"farthest": [hit]}), record(0, {"farthest": [miss]}, framing="whole")]
    write_tables(records, tmp_path)
    rows = read(tmp_path / "results.csv")
    for framing, share in (("close-up", "1.0"), ("whole", "0.0")):
        assert only(rows, framing=framing, angle="all", quantity="first", view="2", method="farthest")["mean"] == share
    assert read(tmp_path / "differences.csv") == []


@pytest.mark.parametrize(
    ("scenes", "views", "methods"), [(1, 5, METHODS), (6, 3, ("farthest", "cross-entropy")), (4, 2, ("random",))]
)
def test_few_scenes_views_and_methods_are_enough(tmp_path, scenes, views, methods):
    records = synthetic_records(scenes, views, methods)
    assert methods_of(records) == [method for method in METHODS if method in methods]
    assert all(path.stat().st_size > 0 for path in write_tables(records, tmp_path))
    names = {path.name for path in write_figures(records, tmp_path)}
    charts = {"hits_close-up.png", "angles_close-up.png"}
    assert names == charts | ({"diagnostics_close-up.png"} if methods != ("random",) else set())
    for name in names:
        with Image.open(tmp_path / name) as image:
            assert image.width > 1000
            assert np.asarray(image.convert("L")).std() > 5


def test_methods_that_some_scenes_lack_are_left_out():
    records = [*synthetic_records(1), *synthetic_records(1, methods=("farthest",))]
    assert methods_of(records) == ["farthest"]
    with pytest.raises(InputError, match="in common"):
        methods_of([*synthetic_records(1, methods=("random",)), *synthetic_records(1, methods=("farthest",))])


def test_what_cannot_be_reported_is_refused(tmp_path):
    with pytest.raises(InputError, match="no records"):
        summary_table([])
    with pytest.raises(InputError, match=r"\[3, 5\]"):
        write_tables([*synthetic_records(1), *synthetic_records(1, views=3)], tmp_path)
    with pytest.raises(InputError, match="'last'"):
        curves(two_scenes(), "random", "last")
    with pytest.raises(InputError, match="'whole'"):
        write_pictures(two_scenes(), "whole", tmp_path)


def test_pictures_show_the_first_scenes(tmp_path):
    records = synthetic_records(2, views=2, methods=("uncertainty", "cross-entropy"))
    (path,) = write_pictures(records[::-1], "close-up", tmp_path, scenes=1)
    assert path == tmp_path / "views_close-up_000.png"
    with Image.open(path) as image:
        assert np.asarray(image.convert("L")).std() > 5
