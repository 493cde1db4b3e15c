"""Sketches drawn during an episode equal those drawn after it."""

import jax
import numpy as np
from small_run import FIRST, SCENE, small_planner

import jaxnbv as nbv
from jaxnbv.viz import Sketches, report_data

PLANNER, KEY, NOISE = small_planner(nbv.DiscreteSearch(8)), jax.random.key(0), nbv.SensorNoise()


def run(views, folder):
    """An episode and its sketches."""
    sketches = Sketches(nbv.Episode(PLANNER, SCENE, NOISE, FIRST, KEY, ()))
    return nbv.simulate(PLANNER, SCENE, FIRST, views, KEY, NOISE, folder, progress=False, each=sketches.add), sketches


def test_steps_are_drawn_as_they_would_be_again_and_a_model_is_asked_only_for_missing_ones(tmp_path, monkeypatch):
    """Sketches of two views, and of the third view that is added to their folder."""
    posterior, calls = nbv.SurfaceSampler.posterior, []

    def counted(sampler, observations):
        calls.append(int(observations.num_views))
        return posterior(sampler, observations)

    runs = [run(views, tmp_path) for views in (2, 3)]
    whole = report_data(runs[1][0], progress=False)
    monkeypatch.setattr(nbv.SurfaceSampler, "posterior", counted)
    for (episode, sketches), held, asked in zip(runs, ([1], [2]), ([2], [1, 3]), strict=True):
        calls.clear()
        assert [*sketches.held] == held
        drawn = report_data(episode, progress=False, sketches=sketches)
        assert calls == asked
        last = len(episode.views) - 1
        assert drawn.views[last].imagined is not None
        jax.tree.map(np.testing.assert_array_equal, drawn.views, whole.views[: last + 1])
