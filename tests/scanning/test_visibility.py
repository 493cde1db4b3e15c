"""Points spread over surfaces, and their visibility from poses, against closed forms."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.pose import look_at
from jaxnbv.scanning import Grid, GridSurface
from jaxnbv.scanning.visibility import SurfacePoints, is_visible, spread_points

GRID = Grid(48, 1.5)
NODES = np.stack(np.meshgrid(*3 * [GRID.axis], indexing="ij"), axis=-1)
CAMERA = Camera(1.2, 40, 40)


def surface_of(distance):
    """The surface where a function of the nodes' coordinates is zero."""
    return GridSurface.from_values(distance(NODES).astype(np.float32), 0.0, GRID)


def ball(middle, radius):
    return lambda x: np.linalg.norm(x - np.asarray(middle), axis=-1) - radius


def test_points_stand_for_equal_areas_of_a_ball():
    middle = np.array([0.1, -0.05, 0.2])
    points, normals, areas = map(np.asarray, spread_points(surface_of(ball(middle, 0.9)), 4000))
    outward = (points - middle) / 0.9
    # Linear interpolation is too low by at most h^2 / (8 R), relative to R.
    np.testing.assert_allclose(np.linalg.norm(outward, axis=1), 1.0, atol=GRID.spacing**2 / (7.0 * 0.9**2))
    assert np.sum(outward * normals, axis=1).min() > 0.999
    assert areas.sum() == pytest.approx(4.0 * np.pi * 0.9**2, rel=0.01)
    weights = areas / areas.sum()
    # The sum over 4,000 points, one in each of as many equal parts of the cells, is accurate to a percent.
    np.testing.assert_allclose(weights @ outward, 0.0, atol=0.01)
    np.testing.assert_allclose((weights * outward.T) @ outward, np.eye(3) / 3.0, atol=0.01)
    cap = weights[outward @ np.array([0.48, 0.6, 0.64]) > 0.5].sum()
    assert cap == pytest.approx(0.25, abs=0.01)
    # Rays meet cells most often where the normal is oblique to all axes. Without weights points would crowd there.
    oblique = np.abs(normals).sum(axis=1) > 1.5
    drawn = np.random.default_rng(1).normal(size=(200_000, 3))
    truly = np.mean(np.abs(drawn).sum(axis=1) / np.linalg.norm(drawn, axis=1) > 1.5)
    assert weights[oblique].sum() == pytest.approx(truly, abs=0.015)
    assert np.mean(oblique) > truly + 0.03


def test_a_surface_without_points_has_no_area():
    _, _, areas = spread_points(surface_of(lambda x: np.ones(x.shape[:-1])), 64)
    assert not areas.any()


def seen_of(surface, poses, points, **limits):
    return np.asarray(is_visible(surface, dataclasses.replace(CAMERA, **limits), poses, points, GRID.spacing))


def test_a_pose_sees_what_faces_it_and_nothing_hides():
    """Two balls in a row, by the cosine and the distance of a ray to the other ball, in float64."""
    middles, radii = np.array([[0.0, 0.0, 0.7], [0.0, 0.1, -0.6]]), (0.4, 0.6)
    both = surface_of(lambda x: np.minimum(*(ball(m, r)(x) for m, r in zip(middles, radii, strict=True))))
    poses = look_at([(0.0, 0.0, 4.0), (4.0, 0.0, 0.0), (0.0, -2.0, 3.0)])
    points = spread_points(both, 1024)
    x, normals = np.asarray(points.points, np.float64), np.asarray(points.normals, np.float64)
    masks = seen_of(both, poses, points)
    own = np.argmin([np.abs(ball(m, r)(x)) for m, r in zip(middles, radii, strict=True)], axis=0)
    for mask, origin in zip(masks, np.asarray(poses.position, np.float64), strict=True):
        offset = x - origin
        away = np.linalg.norm(offset, axis=1)
        direction = offset / away[:, None]
        cosine = -np.sum(direction * normals, axis=1)
        other, reach = middles[1 - own], np.take(radii, 1 - own)
        along = np.sum((other - origin) * direction, axis=1)
        past = np.linalg.norm(other - origin - along[:, None] * direction, axis=1)
        hidden = (past < reach) & (along < away)
        # Points within a cell of the border of the hidden part, or at grazing angles, may differ.
        clear = (np.abs(past - reach) > GRID.spacing) & (np.abs(cosine - 0.2) > 0.05)
        expected = (cosine >= 0.2) & ~hidden
        assert 0.1 < expected.mean() < 0.6
        np.testing.assert_array_equal(mask[clear], expected[clear])
    assert np.mean(np.any(masks, axis=0)) > np.mean(masks, axis=1).max() + 0.1


@functools.cache
def ball_and_points():
    surface = surface_of(ball((0.0, 0.0, 0.0), 0.9))
    return surface, spread_points(surface, 1024)


@pytest.mark.parametrize(
    ("limits", "within"),
    [
        ({"nearest": 2.5}, lambda depth, cosine, angle: depth >= 2.5),
        ({"farthest": 2.5}, lambda depth, cosine, angle: depth <= 2.5),
        ({"max_incidence": 0.7}, lambda depth, cosine, angle: cosine >= np.cos(0.7)),
        ({"fov": 0.3}, lambda depth, cosine, angle: angle < np.tan(0.15)),
    ],
)
def test_a_point_is_seen_within_the_sensors_limits(limits, within):
    (surface, points), pose = ball_and_points(), look_at([(0.0, 0.0, 3.2)])
    x = np.asarray(points.points, np.float64)
    offset = x - [0.0, 0.0, 3.2]
    cosine = -np.sum(offset * x, axis=1) / np.linalg.norm(offset, axis=1) / np.linalg.norm(x, axis=1)
    depth = -offset[:, 2]
    inside = within(depth, cosine, np.abs(offset[:, :2]).max(axis=1) / depth)
    (everything,), (limited,) = seen_of(surface, pose, points), seen_of(surface, pose, points, **limits)
    assert 0 < limited.sum() < everything.sum()
    # Normals from differences are as accurate as the grid.
    assert np.mean(limited != (everything & inside)) < 0.01


def test_what_is_behind_an_obstacle_is_not_seen():
    """The upper half of the image ends at a wall."""
    (surface, points), poses = ball_and_points(), look_at([(0.0, 0.0, 3.2), (3.2, 0.0, 0.0)])
    wall = jnp.where(jnp.arange(CAMERA.num_rays) < CAMERA.num_rays // 2, 1.0, jnp.inf)
    free = np.asarray(is_visible(surface, CAMERA, poses, points, GRID.spacing))
    barrier = jnp.stack([wall, jnp.full_like(wall, 9.0)])
    behind = np.asarray(is_visible(surface, CAMERA, poses, points, GRID.spacing, barrier))
    height = np.asarray(points.points)[:, 1]
    np.testing.assert_array_equal(behind[0], free[0] & (height < 0))
    np.testing.assert_array_equal(behind[1], free[1])


def test_no_ray_sees_what_is_void():
    (surface, points), pose = ball_and_points(), look_at([(0.0, 0.0, 3.2)])
    half = np.zeros(3 * [GRID.resolution - 1], bool)
    half[: GRID.resolution // 2] = True
    free, left = (seen_of(each, pose, points)[0] for each in (surface, surface.without_cells(jnp.asarray(half))))
    away = np.abs(np.asarray(points.points)[:, 0]) > GRID.spacing
    np.testing.assert_array_equal(left[away], (free & (np.asarray(points.points)[:, 0] > 0))[away])


@pytest.mark.as_users
def test_rays_of_a_batch_are_those_of_each():
    """More poses than are processed together."""
    surface, points = ball_and_points()
    points = SurfacePoints(*(rows[:50] for rows in points))
    poses = look_at(jax.random.normal(jax.random.key(0), (40, 3)) + jnp.array([0.0, 0.0, 4.0]))
    together = seen_of(surface, poses, points)
    for i in (0, 17, 31, 32, 39):
        np.testing.assert_array_equal(together[i], seen_of(surface, poses[i][None], points)[0])
