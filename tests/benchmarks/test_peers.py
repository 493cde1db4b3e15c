"""Coverage of scans and boundaries of scanned surface, on shapes with known answers."""

import math
from pathlib import Path

import jax
import numpy as np
import pytest
import trimesh
from covering import Trial, boundary_views, is_boundary, one_a_voxel
from peers import PROTOCOLS, greedy, score
from scipy.spatial import cKDTree

RNG = np.random.default_rng(0)


@pytest.fixture(scope="module")
def ball(tmp_path_factory) -> Path:
    file = tmp_path_factory.mktemp("peers") / "ball.ply"
    trimesh.creation.icosphere(5).export(file)
    return file


def disc(count: int):
    """Points of a disc of radius one that faces up, by Vogel's spiral."""
    turn = math.pi * (3.0 - math.sqrt(5.0)) * np.arange(count)
    radius = np.sqrt((np.arange(count) + 0.5) / count)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), np.zeros(count)], axis=1), radius


def test_the_boundary_of_a_disc_is_its_rim():
    points, radius = disc(1500)
    normals = np.tile([0.0, 0.0, 1.0], (1500, 1))
    apart, near = cKDTree(points).query(points, k=30)
    on_boundary = is_boundary(points, normals, apart[:, 1:], near[:, 1:])
    # Points are 0.05 apart.
    assert np.all(radius[on_boundary] > 0.9)
    assert np.all(on_boundary[radius > 0.999])


def test_views_of_a_boundary_look_at_it_from_above_and_from_both_sides():
    points, _ = disc(1500)
    targets, directions = boundary_views(points, np.tile([0.0, 0.0, 1.0], (1500, 1)), seed=0)
    assert len(targets) == 20
    assert np.all(np.linalg.norm(targets, axis=1) > 0.9)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-9)
    tilt = np.degrees(np.arccos(directions[:, 2]))
    outward = np.sum(directions * targets / np.linalg.norm(targets, axis=1, keepdims=True), axis=1)
    # In turn -45, 0 and 45 degrees about the rim.
    np.testing.assert_allclose(tilt, np.array([45.0, 0.0, 45.0] * 7)[:20], atol=1e-6)
    assert np.all(outward[::3] * np.resize(outward[2::3], len(outward[::3])) < 0)


def test_a_closed_surface_has_no_boundary():
    points = np.asarray(trimesh.creation.icosphere(4).vertices)
    targets, directions = boundary_views(points, points, seed=0)
    assert targets.shape == directions.shape == (0, 3)


def test_one_point_a_voxel_is_the_mean():
    points = np.array([[0.1, 0.1, 0.1], [0.3, 0.1, 0.1], [1.2, 0.0, 0.0]])
    normals = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    rows, mean = one_a_voxel(points, normals, 1.0)
    np.testing.assert_allclose(rows, [[0.2, 0.1, 0.1], [1.2, 0.0, 0.0]])
    np.testing.assert_allclose(mean, [[math.sqrt(0.5), math.sqrt(0.5), 0.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize("name", PROTOCOLS)
def test_a_scan_of_a_ball_covers_the_visible_cap(ball, name):
    protocol = PROTOCOLS[name]
    trial = Trial(ball, protocol, half=False, up="y")
    side = 2.0 * trial.mesh.bounding_radius * trial.unit
    assert side == pytest.approx(0.3 if name == "pb-nbv" else 0.2 / math.sqrt(3.0), rel=1e-3)
    look = trial.look(trial.poses[0])
    # In units of the ball's radius. The visible cap ends where rays are tangent.
    distance = protocol.distance / (0.5 * side)
    toward = np.asarray(trial.poses[0].position) / np.linalg.norm(trial.poses[0].position)
    height = trial.points @ toward / np.linalg.norm(trial.points, axis=1)
    cosine = (distance * height - 1.0) / np.sqrt(distance**2 - 2.0 * distance * height + 1.0)
    assert not np.any(look.covers[cosine < -2.0 * protocol.tolerance / side - 0.05])
    # Rays are s apart, and s / cosine along the slope. No point is farther from a ray than half the diagonal, where the
    # ball is nearest. Means of voxels deviate a little.
    half = 0.5 * protocol.distance * protocol.stride / protocol.camera.focal_lengths[1]
    near_enough = half / math.sqrt(protocol.tolerance**2 - half**2)
    assert np.mean(look.covers[cosine > near_enough + 0.1]) > (0.97 if protocol.voxel else 0.9999)
    np.testing.assert_allclose(np.linalg.norm(look.normals[look.covers], axis=1), 1.0, atol=1e-6)
    if protocol.step:
        assert not np.allclose(np.linalg.norm(look.cloud, axis=1), trial.mesh.bounding_radius, atol=1e-4)


def test_two_opposite_views_cover_most_of_a_ball_and_the_oracle_finds_the_second(ball):
    protocol = PROTOCOLS["pb-nbv"]
    coarse = protocol._replace(stride=8, tolerance=0.02, points=2000)
    trial = Trial(ball, coarse, half=False, up="y")
    first, second, *_ = greedy(trial, 0)
    places = np.asarray(trial.poses.position)
    cosine = places[first] @ places[second] / np.prod(np.linalg.norm(places[[first, second]], axis=1))
    assert cosine < -0.9


def test_a_view_of_half_known_things_is_worth_more_than_one_of_known_ones_alone(ball):
    trial = Trial(ball, PROTOCOLS["benbv"], half=False, up="y")
    look = trial.look(trial.poses[0])
    toward = np.asarray(trial.poses[0].position)
    side = np.cross(toward, jax.random.normal(jax.random.key(0), (3,)))
    half = (trial.points @ side > 0) & look.covers
    # Less than half is known, so that the overlap counts: 1 for a half, and 0 for all.
    assert score(trial, look, half) > score(trial, look, look.covers) + 0.1
