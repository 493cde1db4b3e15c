"""Point clouds: bad input, depth images, and farthest point sampling against a slow greedy version."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxnbv as nbv
from jaxnbv.geometry.cloud import limit_capacity

GOOD = [[0.0, 0.1, 0.2], [0.3, 0.4, 0.5]]
UP = [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]


def test_from_arrays_pads_to_its_capacity():
    cloud = nbv.PointCloud.from_arrays(GOOD, UP, capacity=5)
    assert cloud.capacity == 5
    assert int(cloud.count) == 2
    np.testing.assert_array_equal(cloud.mask, [True, True, False, False, False])
    points, normals = cloud.to_numpy()
    np.testing.assert_allclose(points, GOOD, atol=1e-7)
    np.testing.assert_array_equal(normals, UP)
    assert not np.asarray(cloud.points)[2:].any()
    assert not np.asarray(cloud.normals)[2:].any()
    assert nbv.PointCloud.from_arrays(GOOD, UP).capacity == 2


@pytest.mark.parametrize(
    ("points", "normals", "capacity", "value", "remedy"),
    [
        ([[0.0, math.nan, 0.0], GOOD[0]], UP, None, r"1 of the points are not finite.*row \[0\]", "drop these rows"),
        ([GOOD[0], [math.inf, 0.0, 0.0]], UP, None, r"1 of the points are not finite.*row \[1\]", "drop these rows"),
        (GOOD, [UP[0], [0.0, math.nan, 1.0]], None, r"1 of the normals are not finite.*row \[1\]", "drop these rows"),
        (GOOD, [UP[0], [0.0, 0.0, 0.0]], None, r"1 normals have length zero.*row \[1\]", "estimate normals"),
        (GOOD, UP[:1], None, r"\(2, 3\) and \(1, 3\)", r"must both be \(n, 3\)"),
        ([[0.0, 1.0]], [[0.0, 1.0]], None, r"\(1, 2\) and \(1, 2\)", r"must both be \(n, 3\)"),
        (np.zeros((0, 3)), np.zeros((0, 3)), None, "empty", "at least one point"),
        (GOOD, UP, 1, "2 points do not fit a capacity of 1", r"raise the capacity.*farthest_point_subsample"),
    ],
)
def test_bad_input_is_refused_with_value_and_remedy(points, normals, capacity, value, remedy):
    with pytest.raises(ValueError, match=value) as error:
        nbv.PointCloud.from_arrays(points, normals, capacity)
    assert error.match(remedy)


@pytest.mark.parametrize("length", [5.0, 1e30, 3e38, 1e-11])
def test_normals_of_other_lengths_keep_their_direction_with_a_warning(length):
    with pytest.warns(UserWarning, match=r"row 0: .*normalised"):
        cloud = nbv.PointCloud.from_arrays(GOOD, length * np.array([[0.6, 0.8, 0.0], [0.0, 0.6, -0.8]]))
    np.testing.assert_allclose(cloud.normals, [[0.6, 0.8, 0.0], [0.0, 0.6, -0.8]], rtol=1e-6)


def test_masked_rows_are_not_taken_for_data():
    points = np.ma.masked_array(GOOD, [[False] * 3, [True] * 3])
    with pytest.raises(ValueError, match="points is a masked array: give what is valid"):
        nbv.PointCloud.from_arrays(points, UP)
    np.testing.assert_array_equal(nbv.PointCloud.from_arrays(np.ma.masked_array(GOOD), UP).points, np.float32(GOOD))


def rays_by_hand(camera, pose):
    """Rays through the pixel centres in float64, with a forward component of one."""
    focal = camera.height / 2 / math.tan(camera.fov / 2)
    row, column = np.mgrid[: camera.height, : camera.width]
    x, y = (column + 0.5 - camera.width / 2) / focal, (row + 0.5 - camera.height / 2) / focal
    local = np.stack([x, y, np.ones_like(x)], axis=-1)
    return local @ np.asarray(pose.rotation, dtype=np.float64).T


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.3, 0.4, 0.8), (-0.7, 0.2, 0.6)])
def test_depth_of_a_plane_gives_its_points_and_exact_normals(x64, normal):
    camera, pose = nbv.Camera(height=6, width=9), nbv.look_at((0.3, -0.2, 2.4))
    normal = np.asarray(normal) / np.linalg.norm(normal)
    rays, origin = rays_by_hand(camera, pose), np.asarray(pose.position)
    depth = (0.1 - origin @ normal) / (rays @ normal)
    cloud = nbv.PointCloud.from_depth(depth, camera, pose)
    assert bool(cloud.mask.all())
    expected = (origin + depth[..., None] * rays).reshape(-1, 3)
    np.testing.assert_allclose(cloud.points, expected, atol=1e-12)
    np.testing.assert_allclose(cloud.normals, np.tile(normal, (54, 1)), atol=1e-9)


def test_depth_of_a_sphere_gives_normals_within_a_pixel(x64):
    """A plane through points within a step h on a unit sphere is tilted by less than h, and off by the sagitta."""
    camera, pose = nbv.Camera(height=60, width=60, fov=0.3), nbv.look_at((0.8, 0.9, 2.2), target=(0.1, 0.0, 0.0))
    rays, origin = rays_by_hand(camera, pose), np.asarray(pose.position)
    a, b, c = (rays**2).sum(-1), rays @ origin, origin @ origin - 1
    with np.errstate(invalid="ignore"):
        depth = (-b - np.sqrt(b**2 - a * c)) / a
    cloud = nbv.PointCloud.from_depth(depth, camera, pose)
    np.testing.assert_array_equal(cloud.mask, np.isfinite(depth).ravel())
    points, normals = cloud.to_numpy()
    cosine = -np.sum(points * (points - origin), axis=1) / np.linalg.norm(points - origin, axis=1)
    step = 0.3 / 60 * np.linalg.norm(points - origin, axis=1) / cosine
    np.testing.assert_array_less(np.abs(np.linalg.norm(points, axis=1) - 1.0), step**2)
    radii = points / np.linalg.norm(points, axis=1, keepdims=True)
    error = np.arccos(np.clip(np.sum(radii * normals, axis=1), -1, 1))
    assert len(points) > 3000
    assert (error[cosine > 0.5] < step[cosine > 0.5]).all()
    assert np.median(error) < 0.2 * np.median(step)


def test_a_step_edge_does_not_mix_its_two_sides(x64):
    camera, pose = nbv.Camera(height=5, width=16, fov=0.1), nbv.look_at((0.0, 0.0, 2.5))
    depth = np.where(np.arange(16) < 7, 1.0, 2.0) * np.ones((5, 1))
    cloud = nbv.PointCloud.from_depth(depth, camera, pose)
    assert bool(cloud.mask.all())
    np.testing.assert_allclose(cloud.normals, np.tile([0.0, 0.0, 1.0], (80, 1)), atol=1e-12)


@pytest.mark.parametrize("bad", [math.nan, math.inf, 0.0, -1.0])
def test_invalid_pixels_and_pixels_without_a_plane_are_masked(bad):
    camera, pose = nbv.Camera(height=6, width=7), nbv.look_at((0.8, 0.9, 2.2))
    depth = np.full((6, 7), 2.0)
    depth[1, 2] = bad
    # A lone pixel, a pixel with neighbours in one row only, and one at the end of a row.
    depth[3:, 3:] = bad
    depth[4, 5] = 2.0
    depth[5, :2], depth[4, :3] = 2.0, bad
    valid = depth == 2.0
    expected = np.zeros_like(valid)
    for row, column in np.argwhere(valid):
        near = np.argwhere(valid)[np.abs(np.argwhere(valid) - (row, column)).max(axis=1) <= 1]
        expected[row, column] = len(near) >= 4 and np.linalg.matrix_rank(near - near[0]) == 2
    assert 10 < expected.sum() < valid.sum()
    cloud = nbv.PointCloud.from_depth(depth, camera, pose)
    np.testing.assert_array_equal(cloud.mask.reshape(6, 7), expected)
    assert np.isfinite(cloud.points).all()
    assert not np.asarray(cloud.points)[~expected.ravel()].any()
    assert not np.asarray(cloud.normals)[~expected.ravel()].any()
    np.testing.assert_allclose(cloud.to_numpy()[1] @ np.asarray(pose.forward), -1.0, atol=1e-5)


def greedy(points, mask, count):
    """Rows by the definition of farthest point sampling. The first row wins ties."""
    left = [i for i in range(len(points)) if mask[i]]
    chosen = left[:1]
    left = left[1:]
    while left and len(chosen) < count:
        nearest = [min(((points[i] - points[j]) ** 2).sum() for j in chosen) for i in left]
        chosen.append(left.pop(int(np.argmax(nearest))))
    return chosen


def tagged(points, mask):
    """A cloud whose normals hold the row's number, which tells duplicates apart."""
    mask = np.asarray(mask)
    points = np.where(mask[:, None], points, 0.0).astype(np.float32)
    tags = np.where(mask[:, None], np.arange(len(points))[:, None] * np.ones(3), 0.0).astype(np.float32)
    return nbv.PointCloud(jnp.asarray(points), jnp.asarray(tags), jnp.asarray(mask))


subsample = jax.jit(nbv.geometry.farthest_point_subsample, static_argnums=1)


@settings(max_examples=30)
@given(
    st.lists(st.tuples(*[st.integers(-2, 2)] * 3), min_size=20, max_size=20),
    st.lists(st.booleans(), min_size=20, max_size=20),
    st.sampled_from([1, 6, 20, 23]),
)
def test_farthest_points_against_the_greedy_definition(points, mask, count):
    """Small integers are exact in float32, and give many ties and duplicates."""
    points = np.asarray(points)
    thinned = subsample(tagged(points, mask), count)
    expected = greedy(points, mask, count)
    assert thinned.capacity == count
    np.testing.assert_array_equal(thinned.mask, np.arange(count) < len(expected))
    np.testing.assert_array_equal(thinned.normals[: len(expected), 0], expected)
    np.testing.assert_array_equal(thinned.points[: len(expected)], points[expected])
    assert not np.asarray(thinned.points)[len(expected) :].any()


@pytest.mark.parametrize("capacity", [4, 20, 25])
def test_limit_capacity_keeps_all_points_that_fit(capacity):
    mask = np.isin(np.arange(20), [2, 3, 11, 19])
    cloud = tagged(np.random.default_rng(1).normal(size=(20, 3)), mask)
    thinned = limit_capacity(cloud, capacity)
    np.testing.assert_array_equal(thinned.mask, np.arange(capacity) < 4)
    np.testing.assert_array_equal(thinned.normals[:4, 0], [2, 3, 11, 19])
    np.testing.assert_array_equal(thinned.points[:4], cloud.points[mask])
    assert not np.asarray(thinned.points)[4:].any()


def test_limit_capacity_thins_by_farthest_points_what_does_not_fit():
    rng = np.random.default_rng(2)
    points, mask = rng.integers(-5, 5, size=(30, 3)), rng.random(30) < 0.7
    thinned = limit_capacity(tagged(points, mask), 9)
    np.testing.assert_array_equal(thinned.normals[:, 0], greedy(points, mask, 9))
    assert bool(thinned.mask.all())
