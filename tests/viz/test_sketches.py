"""Sketches drawn during an episode equal those drawn after it."""

import jax
import numpy as np
from small_run import FIRST, SCENE, small_planner

import jaxnbv as nbv
from jaxnbv.viz import Sketches, report_data

PLANNER, KEY, NOISE = small_planner(nbv.DiscreteSearch(12)), jax.random.key(0), nbv.SensorNoise()


def run(views, folder=None):
    """An episode and its sketches."""
    sketches = Sketches(nbv.Episode(PLANNER, SCENE, NOISE, FIRST, KEY, ()))
    return nbv.simulate(PLANNER, SCENE, FIRST, views, KEY, NOISE, folder, progress=False, each=sketches.add), sketches


def assert_equal(drawn, again):
    jax.tree.map(np.testing.assert_array_equal, drawn.views, again.views)


def test_steps_are_drawn_as_they_would_be_again_and_the_model_is_asked_once_more(monkeypatch):
    episode, sketches = run(3)
    again, calls, posterior = report_data(episode, progress=False), [], nbv.SurfaceSampler.posterior

    def told(sampler, observations):
        calls.append(observations)
        return posterior(sampler, observations)

    monkeypatch.setattr(nbv.SurfaceSampler, "posterior", told)
    drawn = report_data(episode, progress=False, sketches=sketches)
    assert_equal(drawn, again)
    assert drawn.views[2].imagined is not None
    assert [int(observations.num_views) for observations in calls] == [3]


def test_of_views_that_a_folder_holds_there_are_none_and_the_report_makes_them(tmp_path):
    run(2, tmp_path)
    episode, sketches = run(3, tmp_path)
    assert [*sketches.held] == [2]
    drawn = report_data(episode, progress=False, sketches=sketches)
    assert_equal(drawn, report_data(episode, progress=False))
    assert drawn.views[1].imagined is not None
