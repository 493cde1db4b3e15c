"""The simulated episode equals ask and tell by hand."""

import equinox as eqx
import jax
import numpy as np
import pytest
from small_planner import FIRST, SCENE, SOLID, planner_of

import jaxnbv as nbv
from jaxnbv.planning.episode import Episode
from jaxnbv.planning.simulate import observe_scene, simulate
from jaxnbv.scanning import Grid, SDFSurface, SensorNoise, mesh_from_sdf, scan
from jaxnbv.scanning.sdf import Sphere
from jaxnbv.search import RandomView

PLANNER = planner_of()
KEY = jax.random.key(5)


def assert_same_bits(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.fixture(scope="module")
def episode():
    return simulate(PLANNER, SCENE, FIRST, 4, KEY, progress=False)


def test_simulate_is_the_loop_of_ask_and_tell(episode):
    """View i draws from fold_in(key, i): one half chooses the view, and one is the sensor's noise."""
    pose, observations = FIRST, None
    for index in range(4):
        choose_key, noise_key = jax.random.split(jax.random.fold_in(KEY, index))
        proposal = None
        if observations is not None:
            proposal = PLANNER.propose(observations, choose_key)
            pose = proposal.pose
        cloud = observe_scene(SCENE, PLANNER.camera, pose, SensorNoise(), noise_key)
        observations = PLANNER.init(pose, cloud) if observations is None else PLANNER.observe(observations, pose, cloud)
        view = episode.views[index]
        assert_same_bits((view.pose, view.scan, view.cloud), (pose, cloud, observations.cloud))
        assert_same_bits(view.proposal, proposal)
        assert_same_bits(episode.observations_after(index + 1), observations)
    assert_same_bits(episode.cloud, observations.cloud)
    assert len(episode.views) == 4
    for wrong in (0, 5):
        with pytest.raises(ValueError, match=f"asked for {wrong} of 4 views"):
            episode.observations_after(wrong)


def test_a_solid_is_simulated_as_its_surface_is():
    ball = Sphere(1.0)
    solid, surface = (simulate(PLANNER, scene, FIRST, 2, KEY, progress=False) for scene in (ball, SDFSurface(ball)))
    assert jax.tree.structure(solid) == jax.tree.structure(surface)
    assert_same_bits(solid.views, surface.views)
    assert int(solid.views[1].scan.count) > 5


def test_a_folder_without_an_episode_is_named(tmp_path):
    with pytest.raises(ValueError, match=str(tmp_path)):
        Episode.load(tmp_path)


def test_views_differ_and_scans_carry_the_sensors_noise(episode):
    positions = np.stack([view.pose.position for view in episode.views])
    assert np.linalg.norm(positions[:, None] - positions[None], axis=-1)[np.triu_indices(4, 1)].min() > 0.5
    for view in episode.views:
        clean = scan(SCENE, PLANNER.camera, view.pose)
        np.testing.assert_array_equal(view.scan.mask, clean.mask)
        error = view.scan.to_numpy()[0] - clean.to_numpy()[0]
        # Five standard errors of a standard deviation from about 150 coordinates.
        assert abs(error.std() / 0.01 - 1) < 5 / np.sqrt(2 * error.size)


def test_a_view_depends_on_the_key_and_its_number_alone(episode):
    shorter = simulate(PLANNER, SCENE, FIRST, 2, KEY, progress=False)
    assert_same_bits(shorter.views, episode.views[:2])
    other = simulate(PLANNER, SCENE, FIRST, 2, jax.random.key(6), progress=False)
    assert (np.asarray(other.views[0].scan.points) != np.asarray(shorter.views[0].scan.points)).any()


def test_an_episode_over_a_mesh_runs_outside_jit():
    mesh = mesh_from_sdf(SOLID, Grid(24))
    assert not mesh.in_jit
    planner = eqx.tree_at(lambda p: p.search, PLANNER, RandomView(12), is_leaf=lambda x: x is PLANNER.search)
    episode = simulate(planner, mesh, FIRST, 2, KEY, progress=False)
    clean = scan(mesh, planner.camera, episode.views[1].pose)
    assert int(clean.count) > 5
    np.testing.assert_array_equal(episode.views[1].scan.mask, clean.mask)


def test_what_views_found_of_a_ball():
    """A view from the other side adds nearly all of the visible cap, 2 pi r^2 (1 - r / d), where surface steeper than
    60 degrees counts less. A view beside the first pose adds nearly nothing."""
    radius, away = 0.8, 4.0
    poses = nbv.look_at([(0.0, 0.0, away), (0.0, 0.0, -away), (0.05, 0.0, away)])
    camera = nbv.Camera(height=40, width=40)
    sampler = nbv.SurfaceSampler(nbv.GeometricSPSR(0.2, truncation=6), nbv.Grid(40), num_samples=2)
    planner = nbv.Planner(nbv.NewSurface(), nbv.DiscreteSearch(poses), camera, sampler, capacity=400, max_views=4)
    scans = [scan(SDFSurface(Sphere(radius)), camera, pose) for pose in poses]
    views = tuple(nbv.View(pose, cloud, cloud, None, camera) for pose, cloud in zip(poses, scans, strict=True))
    first, other_side, again = Episode(planner, None, None, poses[0], KEY, views).actual_scores()
    cap = 2.0 * np.pi * radius**2 * (1.0 - radius / away)
    assert first is None
    assert 0.7 * cap < other_side < cap
    assert again < 0.05 * cap
