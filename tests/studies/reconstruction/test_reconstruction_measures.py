"""What the reconstruction study measures, from records made by hand."""

import pytest

from jaxnbv.studies.engine.results import results, summary
from jaxnbv.studies.reconstruction.study import MEAN, POISSON, ReconstructionStudy


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
    table = results(hand_made(), ReconstructionStudy).set_index(["at", "quantity", "method"]).sort_index()
    row = table.loc[MEAN, "chamfer", "farthest"]
    # Of 0.2 and 0.4: a standard deviation of 0.1414, over the root of two.
    assert (row["mean"], row["standard_error"], row["scenes"]) == (pytest.approx(0.3), pytest.approx(0.1), 2)
    # Both scenes differ by -0.1, so any resample does; the Hausdorff distances by 0.1 and -0.1.
    assert [row["lead"], row["lead_low"], row["lead_high"]] == pytest.approx([-0.1] * 3)
    assert table.loc[(MEAN, "hausdorff", "farthest"), "lead"] == pytest.approx(0.0, abs=1e-12)
    poisson = table.loc[POISSON, "hausdorff", "farthest"]
    assert (poisson["mean"], poisson["scenes"]) == (pytest.approx(0.4), 1)
    assert table.loc[(2, "covered", "farthest"), "mean"] == pytest.approx(0.55)


def test_the_text_goes_without_a_reconstruction_that_no_scene_has():
    assert POISSON in summary(results(hand_made(), ReconstructionStudy), ReconstructionStudy)
    assert POISSON not in summary(results(hand_made()[:1], ReconstructionStudy), ReconstructionStudy)
