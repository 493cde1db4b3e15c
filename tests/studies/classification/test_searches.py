"""Searches of the studies of classes on a small scale: relations between searches on the same samples."""

import functools
import json
import math

import numpy as np
import pytest
from test_pyramid_study import Linear, small_study

from jaxnbv.geometry.camera import Camera
from jaxnbv.studies.classification.objects import PyramidStudy
from jaxnbv.studies.engine.episodes import poses_of
from jaxnbv.studies.engine.run import replay, run_scene

SCENE, VIEWS = 3, 3
SEARCHES = ("cross-entropy", *PyramidStudy.extra_methods)
# One record of all searches, each with its own program.
pytestmark = pytest.mark.slow


@functools.cache
def study():
    few = {"num_samples": 4, "num_starts": 2, "iterations": 2, "camera": Camera(height=12, width=12)}
    return small_study(**few)


@functools.cache
def record():
    return json.loads(json.dumps(run_scene(study(), SCENE, SEARCHES)))


def test_a_search_that_climbs_from_the_candidates_finds_no_less_and_one_with_fewer_samples_no_more():
    """At the second view all have the same samples."""
    value = {method: run["steps"][0]["value"] for method, run in record()["methods"].items()}
    assert {*value} == {*SEARCHES}
    assert value["halving"] <= value["cross-entropy"] + 1e-5
    assert value["hybrid"] >= value["cross-entropy"] - 1e-5


def test_each_search_keeps_to_its_poses():
    poses = {method: poses_of(run)[1:] for method, run in record()["methods"].items()}
    assert all(len(views) == VIEWS - 1 for views in poses.values())
    candidates = np.asarray(study().candidates.poses().position)
    for method in ("cross-entropy", "halving"):
        for pose in poses[method]:
            assert np.linalg.norm(candidates - pose.position, axis=1).min() < 1e-5
    for method, views in poses.items():
        for pose in views:
            distance = np.linalg.norm(pose.position)
            cosine = -pose.position @ pose.forward / distance
            if method == "gradient-constrained":
                assert 2.2 <= distance <= 2.8
                assert cosine >= math.cos(math.radians(10.0)) - 1e-5
            else:
                assert distance == pytest.approx(2.5, abs=1e-4)
                assert cosine == pytest.approx(1.0, abs=1e-5)


def test_what_is_recorded_is_what_the_classifier_says_of_the_views():
    scene, run = study().scene(SCENE), record()["methods"]["gradient-2dof"]
    clouds = [observations.cloud for _, observations in replay(study(), scene, run)]
    np.testing.assert_allclose(run["log_p"][0], [Linear()(cloud) for cloud in clouds], atol=1e-4)
