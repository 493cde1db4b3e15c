"""Views one by one, equal to those of a simulated episode, with the inputs of each."""

import gc
import itertools
import weakref

import equinox as eqx
import jax
import numpy as np
import pytest
from small_planner import CAMERA, FIRST, SCENE, planner_of

from jaxnbv.acquisition import Acquisition
from jaxnbv.checks import InputError
from jaxnbv.geometry.camera import Camera
from jaxnbv.planning.loop import Loop
from jaxnbv.planning.simulate import observe_scene, simulate
from jaxnbv.sampler import SurfaceSampler
from jaxnbv.scanning import SensorNoise
from jaxnbv.search import DiscreteSearch, FarthestView, RandomView, UncertaintyView
from jaxnbv.search.candidates import sphere_candidates

CANDIDATES, KEY = 12, jax.random.key(3)


class FirstRow(Acquisition):
    def context(self, step):
        return None

    def score(self, context, view):
        return view.scan.points[0, 0]


def sensor_of(camera=CAMERA, noise=SensorNoise()):
    return lambda pose, key: observe_scene(SCENE, camera, pose, noise, key)


def views_of(planner, key=KEY, noise=SensorNoise(), camera=CAMERA, first=FIRST):
    for step in Loop(planner, key, camera=camera).steps(sensor_of(camera, noise), first):
        yield step.view


def assert_same(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


def test_a_finer_sensor_sees_more_from_the_same_poses():
    """Nothing is computed for views that nobody asks for."""
    own = planner_of(FarthestView(CANDIDATES))
    fine = views_of(own, camera=Camera(height=16, width=16))
    for view, coarse in zip(itertools.islice(fine, 3), views_of(own), strict=False):
        assert view.scan.capacity == 256
        assert coarse.scan.capacity == 64
        assert int(view.scan.count) > 3 * int(coarse.scan.count) > 0
        assert view.cloud.capacity == coarse.cloud.capacity == 128
        assert_same(view.pose, coarse.pose)


def test_it_ends_at_full_capacity_and_fails_without_candidates():
    """Recorded views are replayed without proposals."""
    own, requests = planner_of(RandomView(CANDIDATES)), []
    whole = list(views_of(own))
    assert len(whole) == 6

    def sensor(pose, key):
        requests.append(pose)
        return sensor_of()(pose, key)

    done = [(view.pose, view.scan, view.proposal) for view in whole[:2]]
    for step, expected in zip(Loop(own, KEY).steps(sensor, FIRST, done), whole, strict=True):
        assert_same(step.view, expected)
    assert len(requests) == 4
    few = views_of(planner_of(FarthestView(2)), first=sphere_candidates(2)[0])
    assert len(list(itertools.islice(few, 2))) == 2
    with pytest.raises(InputError, match="have been visited"):
        next(few)


def test_a_step_holds_the_samples_and_the_observations_that_the_next_view_is_chosen_from():
    own = planner_of(DiscreteSearch(CANDIDATES))
    first, second, third = itertools.islice(Loop(own, KEY).steps(sensor_of(), FIRST), 3)
    assert (first.inputs, first.seconds) == (None, 0.0)
    assert_same(third.inputs.observations, second.observations)
    again = own.choose(third.inputs, jax.random.key(0))
    assert_same(again, third.view.proposal)
    assert third.seconds > 0.0


def test_an_episode_frees_each_posterior_before_the_next(monkeypatch):
    """Each posterior holds hundreds of megabytes at thousands of points."""
    references, posterior = [], SurfaceSampler.posterior

    def told(sampler, observations):
        gc.collect()
        assert all(earlier() is None for earlier in references)
        result = posterior(sampler, observations)
        references.append(weakref.ref(result))
        return result

    monkeypatch.setattr(SurfaceSampler, "posterior", told)
    simulate(planner_of(DiscreteSearch(CANDIDATES)), SCENE, FIRST, 4, KEY, progress=False)
    assert len(references) == 3


def test_another_acquisition_or_search_does_not_compile_the_sampler_again(compilations):
    own = planner_of(DiscreteSearch(CANDIDATES))
    observations = own.init(FIRST, next(views_of(own)).scan)
    surfaces = own.sampler.sample(observations, KEY)
    jax.block_until_ready(surfaces.values)
    del compilations[:]
    other = eqx.tree_at(lambda p: p.acquisition, planner_of(UncertaintyView(CANDIDATES)), FirstRow())
    assert_same(other.sampler.sample(observations, KEY), surfaces)
    assert not compilations
