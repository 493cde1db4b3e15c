"""Views one by one are those of a simulated episode."""

import itertools

import jax
import numpy as np
import pytest

import jaxnbv
from jaxnbv.camera import Camera
from jaxnbv.checks import InputError
from jaxnbv.experiments.episodes import planned_views
from jaxnbv.planner import Planner
from jaxnbv.scanning import Grid, SDFSurface, SensorNoise
from jaxnbv.scanning.sdf import Sphere
from jaxnbv.search import DiscreteSearch, FarthestView, RandomView
from jaxnbv.search.base import sphere_candidates
from jaxnbv.surfaces import GeometricSPSR
from jaxnbv.tasks import Coverage

CANDIDATES, KEY = 10, jax.random.key(3)
SCENE, FIRST = SDFSurface(Sphere(0.8)), sphere_candidates(CANDIDATES)[2]
CAMERA = Camera(height=10, width=10)


def planner(search, views=4):
    return Planner(GeometricSPSR(0.2, truncation=6), CAMERA, Coverage(), search, 2, Grid(16), 150, views)


def assert_same(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.mark.parametrize("search", [DiscreteSearch(CANDIDATES), FarthestView(CANDIDATES), RandomView(CANDIDATES)])
def test_views_are_those_of_a_simulated_episode(search):
    own = planner(search)
    noise = SensorNoise(0.02)
    views = list(planned_views(own, SCENE, FIRST, KEY, noise))
    episode = jaxnbv.simulate(own, SCENE, FIRST, 4, KEY, noise, progress=False)
    assert len(views) == 4
    for view, expected in zip(views, episode.views, strict=True):
        assert_same(view, expected)
    assert len({tuple(np.asarray(view.pose.position).tolist()) for view in views}) == 4
    other = list(itertools.islice(planned_views(own, SCENE, FIRST, jax.random.key(4), noise), 1))
    assert (other[0].scan.points != views[0].scan.points).any()


def test_a_finer_sensor_sees_more_from_the_same_poses():
    """And nothing is computed of views that nobody asks for."""
    own = planner(FarthestView(CANDIDATES))
    fine = planned_views(own, SCENE, FIRST, KEY, sensor=Camera(height=20, width=20))
    for view, coarse in zip(itertools.islice(fine, 3), planned_views(own, SCENE, FIRST, KEY), strict=False):
        assert view.scan.capacity == 400
        assert coarse.scan.capacity == 100
        assert int(view.scan.count) > 3 * int(coarse.scan.count) > 0
        assert view.cloud.capacity == coarse.cloud.capacity == 150
        assert_same(view.pose, coarse.pose)


def test_it_ends_where_the_planner_has_no_room_and_fails_where_no_candidate_is_left():
    assert len(list(planned_views(planner(FarthestView(CANDIDATES), 1), SCENE, FIRST, KEY))) == 1
    few = planned_views(planner(FarthestView(2), 4), SCENE, sphere_candidates(2)[0], KEY)
    assert len(list(itertools.islice(few, 2))) == 2
    with pytest.raises(InputError, match="have been visited"):
        next(few)
