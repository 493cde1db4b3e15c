"""What the pyramid study measures, from records made by hand."""

import csv
import json
import re

import numpy as np
import pytest
from jaxnbv.studies.engine.charts import write_charts
from jaxnbv.studies.engine.tables import summary, write_tables
from PIL import Image

from jaxnbv.studies.classification.objects import PyramidStudy
from jaxnbv.studies.engine.measures import values
from jaxnbv.studies.engine.results import means


def log_p(guesses):
    """Log-probabilities of a sequence of predicted classes."""
    return np.log(0.1 + 0.5 * np.eye(5)[guesses]).tolist()


def run(guesses, pixels):
    return {"candidates": list(range(len(guesses))), "pattern_pixels": pixels, "log_p": log_p(guesses)}


def record(scene, methods, label=1, angle=100.0, framing="close-up", random_hit=0.25, diagnostics=None):
    pixels = [0, 200, 0, 200, 0, 0, 0, 0, 0]
    noted = diagnostics or {}
    held = {name: {"runs": runs, "diagnostics": noted.get(name, [])} for name, runs in methods.items()}
    if "random" in held:
        held["random"]["hit"] = random_hit
    return {
        "scene": scene,
        "framing": framing,
        "split": "test",
        "label": label,
        "first": 0,
        "angle": angle,
        "pattern_pixels": pixels,
        "methods": held,
        "seconds": 1.0,
    }


def synthetic_records(scenes, views=5, methods=PyramidStudy.methods, framing="close-up", seed=0):
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
        diagnostics = {
            name: [
                {"view": view, "roughness": 2.0, "rank_correlation": float(rng.uniform(-1, 1))}
                for view in range(2, views + 1)
            ]
            for name in methods
            if name != "random"
        }
        angle, hit = float(rng.uniform(80, 180)), float(rng.uniform())
        made = record(scene, runs, scene % 5, angle, framing, hit, diagnostics)
        records.append(json.loads(json.dumps(made | {"pattern_pixels": pixels.tolist()})))
    return records


def two_scenes():
    """Cross-entropy hits at view 2 and stays; farthest never sees the pattern, and hits once or never."""
    ours = run([0, 1, 1], [0, 200, 0])
    random = [run([0, 1, 0], [0, 0, 0]), run([0, 0, 1], [0, 0, 0])]
    diagnostics = {
        "cross-entropy": [
            {"view": 2, "roughness": 1.0, "rank_correlation": 0.5},
            {"view": 3, "roughness": 3.0, "rank_correlation": None},
        ],
        "farthest": [{"view": 2, "roughness": 1.0, "rank_correlation": -0.5}],
    }
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


def curves(records, method, quantity):
    return values(records, [method], PyramidStudy.measure(quantity))[:, 0]


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
    for method in set(PyramidStudy.methods) - {"random"}:
        first, stable, pattern = (curves(records, method, quantity) for quantity in ("first", "stable", "pattern"))
        for shares in (first, stable, pattern):
            assert (np.diff(shares, axis=1) >= 0).all()
        assert (stable <= first).all()
        right = [np.argmax(r["methods"][method]["runs"][0]["log_p"][-1]) == r["label"] for r in records]
        np.testing.assert_array_equal(stable[:, -1], right)


def test_diagnostics_are_of_the_methods_own_views():
    found = means(two_scenes(), ["cross-entropy", "farthest"], PyramidStudy.measures)
    rows = found.set_index(["quantity", "method", "at"])
    row = rows.loc["rank_correlation", "farthest", 2]
    assert (row["mean"], row["scenes"]) == (-0.5, 1)
    assert rows.loc[("roughness", "cross-entropy", 3), "mean"] == 3.0
    assert ("rank_correlation", "cross-entropy", 3) not in rows.index
    assert ("roughness", "farthest", 3) not in rows.index


def read(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def only(rows, **wanted):
    (row,) = (row for row in rows if wanted.items() <= row.items())
    return row


def test_tables_hold_shares_computed_by_hand(tmp_path):
    records = two_scenes()
    paths = write_tables(records, PyramidStudy, tmp_path / "new")
    results, differences = (read(path) for path in paths[1:])
    row = only(results, group="all", quantity="first", method="farthest", at="2")
    assert (float(row["mean"]), row["scenes"], float(row["low"]), float(row["high"])) == (0.5, "2", 0.0, 1.0)
    row = only(results, group="first view at 140-180°", quantity="first", method="farthest", at="2")
    assert (float(row["mean"]), float(row["high"]), row["scenes"]) == (0.0, 0.0, "1")
    row = only(results, group="all", quantity="pattern", method="random", at="3")
    assert float(row["mean"]) == pytest.approx(1 - 30 / 56, abs=1e-6)
    assert {row["group"] for row in results} == {"all", "first view at under 110°", "first view at 140-180°"}
    row = only(differences, group="all", quantity="first", baseline="farthest", at="2")
    assert (float(row["mean"]), row["excludes_zero"]) == (0.5, "False")
    row = only(differences, group="all", quantity="stable", baseline="farthest", at="3")
    assert (float(row["mean"]), float(row["low"]), row["excludes_zero"]) == (1.0, 1.0, "True")

    text = paths[0].read_text(encoding="utf-8")
    assert text == summary(records, PyramidStudy)
    head, *lines = text.split("First hit (%), by view\n")[1].splitlines()[:4]
    assert head.split() == ["view", "1", "2", "3"]
    assert lines[1].split()[0] == "farthest"
    assert re.findall(r"\d+", lines[1]) == ["0", "0", "0", "50", "0", "100", "50", "0", "100"]
    compared = text.split("Stable hit (%): cross-entropy minus another method")[1].splitlines()[2]
    assert compared.split() == ["farthest", "+100", "[+100,", "+100]*", "+100", "[+100,", "+100]*"]
    assert max(map(len, text.splitlines())) <= 120


@pytest.mark.parametrize(
    ("scenes", "views", "methods"),
    [(1, 5, PyramidStudy.methods), (6, 3, ("farthest", "cross-entropy")), (4, 2, ("random",))],
)
def test_few_scenes_views_and_methods_are_enough(tmp_path, scenes, views, methods):
    records = synthetic_records(scenes, views, methods)
    assert all(path.stat().st_size > 0 for path in write_tables(records, PyramidStudy, tmp_path))
    paths = write_charts(records, PyramidStudy, tmp_path)
    names = {path.name for path in paths}
    assert names == {"hits.png", "angles.png"} | ({"diagnostics.png"} if methods != ("random",) else set())
    for path in paths:
        with Image.open(path) as image:
            assert image.width > 1000
            assert np.asarray(image.convert("L")).std() > 5
