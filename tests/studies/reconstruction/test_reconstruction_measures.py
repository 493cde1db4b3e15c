"""What the reconstruction study measures, from records made by hand."""

import numpy as np
import pytest
from jaxnbv.studies.engine.charts import write_charts
from jaxnbv.studies.engine.tables import summary

from jaxnbv.studies.engine.results import differences, means
from jaxnbv.studies.reconstruction.study import MEAN, POISSON, ReconstructionStudy

METHODS = ["coverage", "farthest"]


def found(accuracy, completeness, hausdorff):
    both = accuracy + completeness
    return {"chamfer": both, "accuracy": accuracy, "completeness": completeness, "hausdorff": hausdorff}


def made_record(scene, **methods):
    """Of each method the distances of Poisson reconstruction and of the mean."""
    return {"scene": scene, "name": f"object {scene}", "first": 0, "seconds": 1.0} | {
        "methods": {
            name: {
                "candidates": [0, 1],
                "coverage": [0.25, 0.5 + 0.1 * scene],
                "points": 100,
                "reconstructions": {POISSON: poisson, MEAN: mean},
            }
            for name, (poisson, mean) in methods.items()
        }
    }


def hand_made():
    return [
        made_record(0, farthest=(None, found(0.1, 0.1, 0.5)), coverage=(None, found(0.05, 0.05, 0.6))),
        made_record(
            1,
            farthest=(found(0.1, 0.2, 0.4), found(0.2, 0.2, 0.9)),
            coverage=(found(0.1, 0.1, 0.5), found(0.1, 0.2, 0.8)),
        ),
    ]


def test_distances_are_of_the_scenes_that_have_them():
    rows = means(hand_made(), METHODS, ReconstructionStudy.measures).set_index(["at", "quantity", "method"]).loc
    row = rows[MEAN, "chamfer", "farthest"]
    assert (row["mean"], row["scenes"], row["rank"]) == (pytest.approx(0.3), 2, 2)
    # Of 0.2 and 0.4: a standard deviation of 0.1414, over the root of two.
    assert row["standard_error"] == pytest.approx(0.1)
    assert (row["low"], row["high"]) == (pytest.approx(0.2), pytest.approx(0.4))
    assert rows[MEAN, "hausdorff", "farthest"]["mean"] == pytest.approx(0.7)
    poisson = rows[POISSON, "hausdorff", "farthest"]
    assert (poisson["mean"], poisson["scenes"], poisson["rank"]) == (pytest.approx(0.4), 1, 1)
    assert np.isnan(poisson["standard_error"])
    assert rows[2, "covered", "farthest"]["mean"] == pytest.approx(0.55)


def test_differences_are_paired():
    found = differences(hand_made(), METHODS, ReconstructionStudy.measures, "coverage")
    rows = found.set_index(["at", "quantity"]).loc
    row = rows[MEAN, "chamfer"]
    # Both scenes differ by -0.1, so any resample does; the Hausdorff distances by 0.1 and -0.1.
    assert (row["mean"], row["low"], row["high"]) == tuple(map(pytest.approx, (-0.1, -0.1, -0.1)))
    assert row["excludes_zero"]
    assert rows[MEAN, "hausdorff"]["mean"] == pytest.approx(0.0, abs=1e-12)
    assert not rows[MEAN, "hausdorff"]["excludes_zero"]


def test_the_text_and_the_chart_go_without_a_reconstruction_that_no_scene_has(tmp_path):
    text = summary(hand_made(), ReconstructionStudy)
    assert POISSON in text
    assert "-0.100 [-0.100, -0.100]*" in text
    assert " 55 [50, 60]" in text
    assert max(map(len, text.splitlines())) <= 120
    without = hand_made()[:1]
    assert POISSON not in summary(without, ReconstructionStudy)
    for records in (hand_made(), without):
        (path,) = write_charts(records, ReconstructionStudy, tmp_path)
        assert path.name == "reconstruction.png"
