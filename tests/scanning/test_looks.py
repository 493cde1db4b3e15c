"""The looks of views against brute force in float64."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxnbv as nbv
from jaxnbv.geometry.pose_list import PoseList
from jaxnbv.scanning import Looks, scan
from jaxnbv.scanning.sdf import Sphere

GRID, RNG = nbv.Grid(24, 1.2), np.random.default_rng(0)
NODES = np.stack(np.meshgrid(*3 * [GRID.axis], indexing="ij"), axis=-1)
CAMERA, POSE = nbv.Camera(fov=0.9, height=20, width=30), nbv.look_at((0.5, 0.7, 2.4))
BALL = Sphere(0.6)


def cloud_of(points, capacity):
    return nbv.PointCloud.from_arrays(points, points / np.linalg.norm(points, axis=1, keepdims=True), capacity)


def nothing(camera=CAMERA):
    return Looks.empty(GRID, camera, 3)


def distances(points):
    return np.linalg.norm(NODES[..., None, :] - points, axis=-1).min(axis=-1)


def test_distances_are_those_to_all_hits_within_reach():
    """Distances at nodes, for hits of any scan, also for hits outside the grid."""
    points = RNG.uniform(-1.25, 1.25, (60, 3))
    looks = nothing().with_points(cloud_of(points[:40], 50)).with_points(cloud_of(points[40:], 20))
    distance, expected = np.asarray(looks.distance, np.float64), distances(points)
    near = expected < 2.0 * GRID.spacing
    np.testing.assert_allclose(distance[near], expected[near], atol=1e-5)
    assert (distance[~near] >= expected[~near].clip(max=2.0 * GRID.spacing) - 1e-5).all()
    assert distance.max() == pytest.approx(looks.reach)


def test_between_nodes_distances_are_linear():
    looks = nothing().with_points(cloud_of(RNG.uniform(-1.0, 1.0, (30, 3)), 30))
    a, b = NODES[5, 6, 7], NODES[5, 6, 8]
    x = jnp.asarray(np.stack([a, 0.25 * a + 0.75 * b, b]), jnp.float32)
    first, middle, last = np.asarray(looks(x))
    assert middle == pytest.approx(0.25 * first + 0.75 * last, abs=1e-5)


def sampled(*radii):
    """Balls as a batch of sampled surfaces."""
    values = np.stack([np.linalg.norm(NODES, axis=-1) - radius for radius in radii])
    return nbv.scanning.GridSurface.from_values(values.astype(np.float32), 0.0, GRID)


def after(pose, cloud, camera=CAMERA, barrier=None):
    """The looks and the poses after one view."""
    looks = nothing().with_view(jnp.asarray(0), pose, cloud, camera, barrier)
    return looks, PoseList.empty(3).append(pose)


def shown(surfaces, pose, index=0):
    """Number of rays that hit a sampled surface."""
    return int(scan(jax.tree.map(lambda leaf: leaf[index], surfaces), CAMERA, pose).mask.sum())


EMPTY = nbv.PointCloud(jnp.zeros((600, 3)), jnp.zeros((600, 3)), jnp.zeros(600, bool), jnp.zeros(600, bool))


def test_measured_surface_stays_and_unmeasured_surface_is_left_out():
    """A view of the ball of radius 0.6 keeps the sample of radius 0.6, and hides the one of 0.8 from there. From the
    other side, which was not seen, it is still visible."""
    surfaces = sampled(0.6, 0.8)
    looks, poses = after(POSE, scan(nbv.SDFSurface(BALL), CAMERA, POSE))
    remaining = looks.without_unmeasured(surfaces, poses)
    behind = nbv.look_at(-POSE.position)
    assert shown(remaining, POSE) == shown(surfaces, POSE)
    assert shown(remaining, behind) == shown(surfaces, behind)
    # At the limb a look is too steep to count.
    assert shown(remaining, POSE, 1) < 0.5 * shown(surfaces, POSE, 1)
    assert shown(remaining, behind, 1) > 0.9 * shown(surfaces, behind, 1)


def test_a_view_without_a_return_looked_only_as_far_as_it_saw():
    """Up to 60 degrees without an end, up to the very limb with a wall behind the ball, and not at all if something
    stood before the ball, or if nothing was seen."""
    surfaces = sampled(0.6)

    def remaining(sight, barrier=None):
        looks, poses = after(POSE, dataclasses.replace(EMPTY, sight=jnp.full(600, sight)), barrier=barrier)
        return shown(looks.without_unmeasured(surfaces, poses), POSE)

    everything = shown(surfaces, POSE)
    assert remaining(np.inf) < 0.5 * everything
    assert remaining(4.0) < 0.5 * remaining(np.inf)
    assert remaining(1.0) == remaining(0.0) == everything
    assert remaining(np.inf, jnp.full(600, 1.0)) == everything


def test_fine_sensors_keep_a_stride_of_rays():
    looks = Looks.empty(GRID, nbv.Camera(height=480, width=640), 2)
    assert 2_000 < looks.camera.num_rays <= 5_000
    assert looks.sight.shape == (2, looks.camera.num_rays)


def test_the_sight_of_a_finer_sensor_is_that_of_the_pixel_about_each_ray():
    fine = CAMERA.resized(60, 90)
    image = RNG.uniform(1.0, 3.0, (60, 90))
    empty = jax.tree.map(lambda leaf: jnp.zeros((5400, *leaf.shape[1:]), leaf.dtype), EMPTY)
    looks, _ = after(POSE, dataclasses.replace(empty, sight=jnp.asarray(image.reshape(-1), jnp.float32)), fine)
    np.testing.assert_allclose(looks.sight[0].reshape(20, 30), image[1::3, 1::3], rtol=1e-6)
    narrow = nbv.Camera(fov=0.3, height=60, width=90)
    looks, _ = after(POSE, dataclasses.replace(empty, sight=jnp.ones(5400)), narrow)
    middle = np.asarray(looks.sight[0]).reshape(20, 30)
    assert middle[10, 15] == 1.0
    assert middle[0, 0] == 0.0


def test_a_depth_image_says_how_far_it_saw():
    """It saw up to a wall, even before the box, and without limit where nothing returned. In units of the frame."""
    camera = nbv.Camera(fov=0.8, height=24, width=24)
    depth = np.full((24, 24), 1.0)
    depth[:, 12:] = 0.0
    depth[0, 0], depth[0, 23], depth[23, 23] = np.nan, np.inf, -1.0
    box = nbv.Box((-1.0, -1.0, -1.0), (1.0, 1.0, 0.5))
    with pytest.warns(UserWarning, match="none of the"):
        cloud = nbv.PointCloud.from_depth(depth, camera, nbv.look_at((0.0, 0.0, 2.5)), box=box)
    lengths = np.linalg.norm(np.asarray(camera.pixel_directions()), axis=1).reshape(24, 24)
    expected = np.where((depth > 0) & (depth < np.inf), lengths, np.inf)
    np.testing.assert_allclose(np.asarray(cloud.sight).reshape(24, 24), expected, rtol=1e-6)
    scene = nbv.geometry.Frame(scale=3.0).to_scene(cloud)
    np.testing.assert_allclose(np.asarray(scene.sight).reshape(24, 24), 3.0 * expected, rtol=1e-6)


def test_a_simulated_scan_says_how_far_it_saw():
    """It saw up to its hits. A surface that is too oblique returns nothing."""
    camera = nbv.Camera(fov=0.6, height=40, width=40, max_incidence=0.8)
    pose = nbv.look_at((0.0, 0.0, 2.5))
    cloud = scan(nbv.SDFSurface(BALL), camera, pose)
    away = np.linalg.norm(np.asarray(cloud.points) - np.asarray(pose.position), axis=1)
    np.testing.assert_allclose(cloud.sight, np.where(cloud.mask, away, np.inf), rtol=1e-6)
    assert int((~cloud.mask & ~cloud.missed).sum()) > 0
