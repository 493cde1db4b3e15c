"""Depth images as a sensor gives them: units, strides, a box, range; and what cannot be meant."""

import functools
import itertools
import operator

import numpy as np
import pytest

import jaxnbv as nbv
from jaxnbv.scanning.sdf import Cuboid, Sphere

# In metres, z up: a ball on a table, 0.8 m from the camera, and a pillar between them at the left.
BALL = Sphere(0.1).translate([0.0, 0.0, 0.1])
TABLE = Cuboid([0.6, 0.6, 0.02]).translate([0.0, 0.0, -0.02])
PILLAR = Cuboid([0.01, 0.01, 0.4]).translate([-0.05, -0.5, 0.4])
POSE = nbv.look_at((0.0, -0.8, 0.3), (0.0, 0.0, 0.1), up=(0.0, 0.0, 1.0))
CAMERA = nbv.Camera.from_intrinsics([[90.0, 0.0, 34.0], [0.0, 95.0, 21.5], [0.0, 0.0, 1.0]], width=64, height=48)
BOX = nbv.Box((-0.15, -0.15, 0.002), (0.15, 0.15, 0.25))


def depth_of(*solids, camera=CAMERA, pose=POSE):
    """Along the camera's axis; infinite where nothing is hit."""
    seen = nbv.scan(nbv.SDFSurface(functools.reduce(operator.or_, solids)), camera, pose)
    depth = (np.asarray(seen.points, np.float64) - np.asarray(pose.position)) @ np.asarray(pose.forward, np.float64)
    return np.where(seen.mask, depth, np.inf).reshape(camera.height, camera.width)


def test_millimetres_of_a_sensor_give_the_points_in_metres():
    """Integers, holes of zero, an off-centre camera with pixels that are not square."""
    depth = depth_of(BALL)
    image = np.where(np.isfinite(depth), np.round(1000.0 * depth), 0.0).astype(np.uint16)
    cloud = nbv.PointCloud.from_depth(image, CAMERA, POSE, depth_scale=1e-3)
    points, normals = cloud.to_numpy()
    assert len(points) > 200
    outward = (points - [0.0, 0.0, 0.1]) / 0.1
    assert np.abs(np.linalg.norm(outward, axis=1) - 1.0).max() < 0.02
    assert np.median(np.sum(outward * normals, axis=1)) > 0.97
    assert not np.asarray(cloud.missed).any()


@pytest.mark.parametrize("stride", [2, 3, 5])
def test_a_strided_image_has_rows_of_the_whole(stride):
    """Planes are fitted to all pixels."""
    strided, rows = CAMERA.strided(stride), slice(stride // 2, None, stride)
    cloud, whole = (nbv.PointCloud.from_depth(depth_of(BALL, TABLE), CAMERA, POSE, stride=n) for n in (stride, 1))
    assert cloud.capacity == strided.num_rays
    for name in ("points", "normals", "mask", "missed"):
        kept = np.asarray(getattr(whole, name)).reshape(CAMERA.height, CAMERA.width, -1)[rows, rows]
        np.testing.assert_allclose(getattr(cloud, name), kept.reshape(getattr(cloud, name).shape), atol=1e-6)
    points = np.asarray(cloud.points, np.float64) - np.asarray(POSE.position)
    along = points / np.linalg.norm(points, axis=1, keepdims=True) @ np.asarray(POSE.rotation, np.float64)
    rays = np.asarray(strided.pixel_directions(), np.float64)
    expected = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    np.testing.assert_allclose(along[np.asarray(cloud.mask)], expected[np.asarray(cloud.mask)], atol=1e-5)


def test_a_box_keeps_the_object_and_knows_what_was_crossed():
    depth = depth_of(BALL, TABLE, PILLAR)
    whole, cropped = (nbv.PointCloud.from_depth(depth, CAMERA, POSE, box=box) for box in (None, BOX))
    points = np.asarray(whole.points, np.float64)
    low, high = np.array(BOX.low), np.array(BOX.high)
    inside = np.asarray(whole.mask) & np.all((points >= low) & (points <= high), axis=1)
    np.testing.assert_array_equal(cropped.mask, inside)
    assert inside.sum() > 200
    # Ray by ray, in float64 and by small steps: does the way to the hit leave the box again, or never meet it?
    position = np.asarray(POSE.position, np.float64)
    rays = np.asarray(CAMERA.pixel_directions(), np.float64) @ np.asarray(POSE.rotation, np.float64).T
    steps = np.linspace(0.0, 3.0, 3001)[:, None, None]
    places = position + steps * rays
    within = np.all((places >= low) & (places <= high), axis=2)
    last = np.where(within.any(axis=0), steps[len(steps) - 1 - np.argmax(within[::-1], axis=0), 0, 0], -np.inf)
    flat = depth.reshape(-1)
    hit = np.isfinite(flat)
    beyond = hit & ~inside & (flat > last)
    sure = np.abs(flat - last) > 2e-3
    missed = np.asarray(cropped.missed)
    np.testing.assert_array_equal(missed[sure], (~hit | beyond)[sure])
    # The pillar hides a part of the box: of that nothing is known.
    hidden = ~missed & ~np.asarray(cropped.mask) & hit
    assert hidden.sum() > 20
    assert (np.abs(points[hidden & np.asarray(whole.mask)][:, 1] + 0.5) < 0.02).mean() > 0.9


def test_beyond_its_range_a_sensor_met_nothing_and_before_it_says_nothing():
    limited = nbv.Camera.from_intrinsics(CAMERA.intrinsics, 48, 64, nearest=0.72, farthest=0.9)
    depth = depth_of(BALL, TABLE)
    cloud = nbv.PointCloud.from_depth(depth, limited, POSE)
    flat = depth.reshape(-1)
    np.testing.assert_array_equal(cloud.missed, flat > 0.9)
    assert not np.asarray(cloud.mask)[(flat < 0.72) | (flat > 0.9)].any()
    assert int(cloud.count) > 200


def test_what_cannot_be_meant_is_named():
    depth = depth_of(BALL, TABLE)
    ranged = nbv.Camera.from_intrinsics(CAMERA.intrinsics, 48, 64, nearest=0.1, farthest=3.0)
    turned = nbv.Pose.from_matrix(POSE.matrix, "opengl")
    for image, camera, pose, options, message in (
        (1000.0 * depth, ranged, POSE, {}, r"out of the camera's range of 0\.1 to 3: give the depth's scale, 0\.001"),
        (
            1000.0 * depth,
            CAMERA,
            POSE,
            {"box": BOX},
            r"median of .*, but the box is 0\.\d+ to .* away: give the depth's",
        ),
        (depth, CAMERA, turned, {"box": BOX}, r"lies behind the camera .* Pose\.from_matrix\(matrix, \"opengl\"\)"),
        (depth, CAMERA, POSE, {"depth_scale": 0.0}, "scale is 0.0"),
        (depth, CAMERA, POSE, {"stride": 0}, "stride is 0"),
        (depth[1:], CAMERA, POSE, {}, r"\(47, 64\) but the camera has \(48, 64\).*Camera\(height"),
    ):
        with pytest.raises(nbv.InputError, match=message):
            nbv.PointCloud.from_depth(image, camera, pose, **options)


def test_depths_beyond_the_type_say_nothing_and_only_infinity_says_nothing_is_there():
    camera, pose = nbv.Camera(height=4, width=4), nbv.look_at((0.0, 0.0, 2.5))
    for depth, missed in ((3.5e38, 0), (1e300, 0), (np.inf, 16)):
        cloud = nbv.PointCloud.from_depth(np.full((4, 4), depth), camera, pose)
        assert int(cloud.count) == 0
        assert int(cloud.missed.sum()) == missed


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_pixels_that_mix_a_near_and_a_far_surface_are_left_out_and_thin_parts_stay(share, noise):
    """A ball and a leg three pixels wide, 0.8 m away before a wall; in some of the pixels beside an edge the depth is
    anywhere between."""
    camera = CAMERA.resized(192, 256)
    leg = Cuboid([0.0035, 0.0035, 0.1]).translate([0.14, 0.0, 0.1])
    near = np.minimum(depth_of(BALL, leg, camera=camera), 1.6)
    far = near
    for axis, shift in itertools.product((0, 1), (-1, 1)):
        far = np.maximum(far, np.roll(near, shift, axis))
    rng = np.random.default_rng(0)
    mixed = (far - near > 0.1) & (rng.uniform(size=near.shape) < share)
    depth = np.where(mixed, near + rng.uniform(size=near.shape) * (far - near), near)
    points, _ = nbv.PointCloud.from_depth(depth + noise * rng.normal(size=near.shape), camera, POSE).to_numpy()
    object_points = points[points[:, 1] < 0.3]
    away = np.minimum(*(np.abs(np.asarray(solid(object_points))) for solid in (BALL, leg)))
    assert away.max() < 0.012
    assert len(object_points) > 0.95 * np.sum((near < 1.6) & ~mixed)
    assert np.sum(np.abs(object_points[:, 0] - 0.14) < 0.01) > (280 if share == 0 else 80)
