"""Depth images of a sensor: units, strides, boxes, ranges, and input that cannot be right."""

import itertools
import warnings

import jax
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import jaxnbv as nbv
from jaxnbv.geometry.gaps import find_block_side

# In metres, z up: a ball on a table, 0.8 m from the camera, and a pillar between them at the left. Each solid is its
# centre and its radius or half sides.
BALL = [0.0, 0.0, 0.1], 0.1
TABLE = [0.0, 0.0, -0.02], [0.6, 0.6, 0.02]
PILLAR = [-0.05, -0.5, 0.4], [0.01, 0.01, 0.4]
POSE = nbv.look_at((0.0, -0.8, 0.3), (0.0, 0.0, 0.1), up=(0.0, 0.0, 1.0))
CAMERA = nbv.Camera.from_intrinsics([[90.0, 0.0, 34.0], [0.0, 95.0, 21.5], [0.0, 0.0, 1.0]], width=64, height=48)
BOX = nbv.Box((-0.15, -0.15, 0.002), (0.15, 0.15, 0.25))


def rays_of(camera):
    """The camera's position and the rays of its pixels, whose lengths along the camera's axis are one, in float64."""
    rays = np.asarray(camera.pixel_directions(), np.float64) @ np.asarray(POSE.rotation, np.float64).T
    return np.asarray(POSE.position, np.float64), rays


def depth_of(*solids, camera=CAMERA):
    """Depth along the camera's axis in closed form. Infinite where nothing is hit."""
    origin, rays = rays_of(camera)
    depth = np.full(len(rays), np.inf)
    for center, size in solids:
        away = origin - center
        if np.ndim(size):
            with np.errstate(divide="ignore"):
                ends = np.sort([(side * np.array(size) - away) / rays for side in (-1, 1)], axis=0)
            enter, leave = ends[0].max(axis=1), ends[1].min(axis=1)
            depth = np.minimum(depth, np.where(enter < leave, enter, np.inf))
        else:
            a, b, c = (rays**2).sum(axis=1), rays @ away, away @ away - size**2
            root = np.sqrt(np.maximum(b**2 - a * c, 0.0))
            depth = np.minimum(depth, np.where(root > 0, (-b - root) / a, np.inf))
    return depth.reshape(camera.height, camera.width)


def test_millimetres_of_a_sensor_give_the_points_in_metres():
    """Integers, zeros for holes, an off-centre camera, and pixels that are not square."""
    depth = depth_of(BALL)
    image = np.where(np.isfinite(depth), np.round(1000.0 * depth), 0.0).astype(np.uint16)
    cloud = nbv.PointCloud.from_depth(image, CAMERA, POSE, depth_scale=1e-3)
    points, normals = cloud.to_numpy()
    assert len(points) > 200
    outward = (points - [0.0, 0.0, 0.1]) / 0.1
    assert np.abs(np.linalg.norm(outward, axis=1) - 1.0).max() < 0.02
    assert np.median(np.sum(outward * normals, axis=1)) > 0.97
    assert not np.asarray(cloud.missed).any()


@pytest.mark.parametrize("stride", [2, 5])
def test_a_strided_image_has_rows_of_the_whole(stride):
    """Planes are fitted to all pixels, whatever the stride."""
    strided, rows = CAMERA.strided(stride), slice(stride // 2, None, stride)
    cloud, whole = (nbv.PointCloud.from_depth(depth_of(BALL, TABLE), CAMERA, POSE, stride=n) for n in (stride, 1))
    assert cloud.capacity == strided.num_rays
    for name in ("points", "normals", "mask", "missed"):
        rows_of_whole = np.asarray(getattr(whole, name)).reshape(CAMERA.height, CAMERA.width, -1)[rows, rows]
        np.testing.assert_allclose(getattr(cloud, name), rows_of_whole.reshape(getattr(cloud, name).shape), atol=1e-6)
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
    # For each ray, in float64 by small steps: whether it leaves the box again before its hit, or never meets the box.
    position, rays = rays_of(CAMERA)
    steps = np.linspace(0.4, 1.4, 1001)[:, None, None]
    places = position + steps * rays
    within = np.all((places >= low) & (places <= high), axis=2)
    last = np.where(within.any(axis=0), steps[len(steps) - 1 - np.argmax(within[::-1], axis=0), 0, 0], -np.inf)
    flat = depth.reshape(-1)
    hit = np.isfinite(flat)
    beyond = hit & ~inside & (flat > last)
    sure = np.abs(flat - last) > 2e-3
    missed = np.asarray(cropped.missed)
    np.testing.assert_array_equal(missed[sure], (~hit | beyond)[sure])
    # The pillar hides a part of the box, where nothing is known.
    hidden = ~missed & ~np.asarray(cropped.mask) & hit
    assert hidden.sum() > 20
    assert (np.abs(points[hidden & np.asarray(whole.mask)][:, 1] + 0.5) < 0.02).mean() > 0.9


def test_depths_beyond_the_range_are_misses_and_nearer_ones_unknown():
    limited = nbv.Camera.from_intrinsics(CAMERA.intrinsics, 48, 64, nearest=0.72, farthest=0.9)
    depth = depth_of(BALL, TABLE)
    cloud = nbv.PointCloud.from_depth(depth, limited, POSE)
    flat = depth.reshape(-1)
    np.testing.assert_array_equal(cloud.missed, flat > 0.9)
    assert not np.asarray(cloud.mask)[(flat < 0.72) | (flat > 0.9)].any()
    assert int(cloud.count) > 200


def image_with(mark, background, dtype):
    """The ball before a background, in millimetres or metres. In the left half, `mark` replaces all unmeasured
    depths."""
    depth = depth_of(BALL)
    ball = np.isfinite(depth)
    image = np.where(ball, 1000.0 * depth, background)
    image[:, :32][ball[:, :32]] = mark
    return np.round(image).astype(dtype) / (1.0 if dtype == np.uint16 else 1000.0), ball


WALL = 2500.0 + 5.0 * np.random.default_rng(0).normal(size=(48, 64))


@pytest.mark.parametrize(
    ("mark", "alone", "dtype", "farthest"),
    [
        (65535, True, np.uint16, 2.0),
        (32767, False, np.uint16, None),
        (10000, True, np.float32, None),
        (8191, False, np.float32, 2.0),
        (4095, True, np.uint16, None),
        (2047, False, np.float32, None),
        (2047, True, np.uint16, 2.0),
    ],
)
@pytest.mark.filterwarnings("ignore:the depth image has the value")
def test_a_mark_of_missing_depth_equals_zero(mark, alone, dtype, farthest):
    """The clouds are the same row by row, and no node within the ball is known to be empty."""
    camera = nbv.Camera.from_intrinsics(CAMERA.intrinsics, 48, 64, farthest=farthest)
    scale = 1e-3 if dtype == np.uint16 else 1.0
    clouds = []
    for value in (mark, 0):
        image, ball = image_with(value, value if alone else WALL, dtype)
        clouds.append(nbv.PointCloud.from_depth(image.astype(dtype), camera, POSE, depth_scale=scale, box=BOX))
    for name in ("points", "mask", "missed", "sight"):
        np.testing.assert_array_equal(getattr(clouds[0], name), getattr(clouds[1], name))
    assert not np.asarray(clouds[0].missed).reshape(48, 64)[ball].any()
    assert int(clouds[0].count) > 100
    grid, frame = nbv.Grid(40), nbv.Frame.fit(np.array([BOX.low, BOX.high]), up="z")
    scene = (frame.to_scene(one) for one in (POSE, clouds[0], camera))
    empty = np.asarray(nbv.Carving().empty_nodes(grid, *scene))
    nodes = np.stack(np.meshgrid(*[grid.axis] * 3, indexing="ij"), axis=-1)
    center = np.asarray(frame.to_scene(np.array([[0.0, 0.0, 0.1]])))[0]
    assert not empty[np.linalg.norm(nodes - center, axis=-1) < 0.095 * frame.scale].any()


def test_a_mark_is_warned_of_and_a_wall_and_a_floor_are_not(recwarn):
    image, _ = image_with(10000, WALL, np.uint16)
    with pytest.warns(UserWarning, match=r"value 10000 in \d+ pixels.*not measured.*Give infinity"):
        nbv.PointCloud.from_depth(image, CAMERA, POSE, depth_scale=1e-3, box=BOX)
    recwarn.clear()
    for other in (image_with(0, WALL, np.uint16)[0], np.round(1000 * depth_of(BALL, TABLE)), np.full((48, 64), 9e3)):
        cloud = nbv.PointCloud.from_depth(np.where(np.isfinite(other), other, 0), CAMERA, POSE, depth_scale=1e-3)
        assert int(cloud.count) > 100
    assert len(recwarn) == 0


@pytest.mark.filterwarnings("ignore:the depth image has the value")
@pytest.mark.parametrize(
    ("rest", "farthest"), [(1e10, None), (65504.0, 3.0), (100.0, None), (20.0, 3.0), (0.01, None), ("a wall", None)]
)
def test_a_far_background_and_glare_are_no_other_units(rest, farthest):
    depth = depth_of(BALL)
    camera = nbv.Camera.from_intrinsics(CAMERA.intrinsics, 48, 64, nearest=0.1, farthest=farthest)
    background = 20.0 + 0.01 * np.arange(64) if rest == "a wall" else rest
    image = np.where(np.isfinite(depth), depth, background)
    cloud, alone = (nbv.PointCloud.from_depth(one, camera, POSE, box=BOX) for one in (image, depth))
    np.testing.assert_array_equal(cloud.mask, alone.mask)
    np.testing.assert_allclose(cloud.points, alone.points, atol=1e-3)


FINE = nbv.Camera.from_intrinsics([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]], width=640, height=480)
SPARSE = {
    "every 8th row": lambda v, u: v % 8 == 3,
    "every 2nd column": lambda v, u: u % 2 == 1,
    "every 4th pixel": lambda v, u: (v % 4 == 1) & (u % 4 == 3),
    "a lidar": lambda v, u: (v % 6 == 5) & (u % 2 == 0),
    "5 % at random": lambda v, u: np.random.default_rng(0).random(v.shape) < 0.05,
}


# No side of the blocks is a multiple of the stride.
STRIDE = 5


@pytest.mark.parametrize("name", SPARSE)
def test_an_image_with_gaps_shows_the_object(name):
    """Almost as many rows as from the whole image, on their rays, near the ball and with its normals."""
    depth = depth_of(BALL, TABLE, camera=FINE)
    image = np.where(np.isfinite(depth) & SPARSE[name](*np.mgrid[:480, :640]), np.round(1e4 * depth), 0.0)
    whole = nbv.PointCloud.from_depth(np.where(np.isfinite(depth), depth, 0.0), FINE, POSE, 1.0, STRIDE, BOX)
    cloud = nbv.PointCloud.from_depth(image.astype(np.uint16), FINE, POSE, 1e-4, STRIDE, BOX)
    points, normals = (np.asarray(rows, np.float64) for rows in cloud.to_numpy())
    assert 0.6 * int(whole.count) < len(points) < 1.4 * int(whole.count)
    outward = points - [0.0, 0.0, 0.1]
    distance = np.linalg.norm(outward, axis=1)
    assert np.median(np.abs(distance - 0.1)) < 4e-3
    assert np.median(np.sum(outward * normals, axis=1) / distance) > np.cos(np.radians(10.0))
    rays = np.asarray(FINE.strided(STRIDE).pixel_directions(), np.float64)[np.asarray(cloud.mask)]
    local = (points - np.asarray(POSE.position, np.float64)) @ np.asarray(POSE.rotation, np.float64)
    np.testing.assert_allclose(local / local[:, 2:], rays, atol=1e-5)
    # Rays between the samples are not taken to have passed.
    assert not np.asarray(cloud.missed & whole.mask).any()
    both = np.asarray(cloud.mask & whole.mask)
    assert np.median(np.abs(np.asarray(cloud.sight) / np.asarray(whole.sight) - 1.0)[both]) < 0.03


def test_holes_are_no_gaps():
    """A quarter of the pixels in clumps, as from a sensor. Each has neighbours, so that none stands for others. Few
    have neighbours if as many pixels are random."""
    noise = gaussian_filter(np.random.default_rng(0).normal(size=(240, 320)), 1.5)
    clumps = noise > np.quantile(noise, 0.75)
    assert find_block_side(clumps) == 1
    assert find_block_side(np.random.default_rng(1).permutation(clumps.ravel()).reshape(clumps.shape)) > 1
    assert find_block_side(np.zeros((8, 8), bool)) == 1


def test_planes_are_seen_exactly_between_samples():
    """Planes are linear in inverse depth, so that the pattern and the phase of the gaps do not matter."""
    depth, box = depth_of(([0.0, 0.0, -1.0], [3.0, 3.0, 1.0]), camera=FINE), nbv.Box((-1.0,) * 3, (1.0,) * 3)
    for keep in SPARSE.values():
        image = np.where(np.isfinite(depth) & keep(*np.mgrid[:480, :640]), depth, 0.0)
        points, normals = nbv.PointCloud.from_depth(image, FINE, POSE, 1.0, STRIDE, box).to_numpy()
        # Farther away the plane is too oblique for a fit.
        points, normals = points[points[:, 1] < 0.0], normals[points[:, 1] < 0.0]
        assert len(points) > 2000
        assert np.percentile(np.abs(points[:, 2]), 99) < 1e-4
        assert np.percentile(normals[:, 2], 1) > np.cos(np.radians(0.1))


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


def test_only_infinity_is_a_miss():
    camera, pose = nbv.Camera(height=4, width=4), nbv.look_at((0.0, 0.0, 2.5))
    for depth, missed in ((3.5e38, 0), (1e300, 0), (np.inf, 16)):
        cloud = nbv.PointCloud.from_depth(np.full((4, 4), depth), camera, pose)
        assert int(cloud.count) == 0
        assert int(cloud.missed.sum()) == missed


@pytest.mark.parametrize(("share", "noise"), [(0.0, 1e-3), (0.5, 0.0), (1.0, 1e-3)])
def test_pixels_that_mix_a_near_and_a_far_surface_are_left_out_and_thin_parts_stay(share, noise):
    """A ball and a leg three pixels wide stand 0.8 m away before a wall. Some of the pixels beside an edge have a depth
    anywhere between the two."""
    camera = CAMERA.resized(192, 256)
    leg = [0.14, 0.0, 0.1], [0.0035, 0.0035, 0.1]
    near = np.minimum(depth_of(BALL, leg, camera=camera), 1.6)
    far = near
    for axis, shift in itertools.product((0, 1), (-1, 1)):
        far = np.maximum(far, np.roll(near, shift, axis))
    rng = np.random.default_rng(0)
    mixed = (far - near > 0.1) & (rng.uniform(size=near.shape) < share)
    depth = np.where(mixed, near + rng.uniform(size=near.shape) * (far - near), near)
    noisy = depth + noise * rng.normal(size=near.shape)
    points = np.asarray(nbv.PointCloud.from_depth(noisy, camera, POSE, stride=2).to_numpy()[0], np.float64)
    points = points[points[:, 1] < 0.3]
    from_ball = np.abs(np.linalg.norm(points - BALL[0], axis=1) - BALL[1])
    from_leg = np.linalg.norm(np.maximum(np.abs(points - leg[0]) - leg[1], 0.0), axis=1)
    assert np.minimum(from_ball, from_leg).max() < 0.012
    assert len(points) > 0.95 * np.sum(((near < 1.6) & ~mixed)[1::2, 1::2])
    assert np.sum(np.abs(points[:, 0] - 0.14) < 0.01) > (70 if share == 0 else 20)


def test_holes_of_an_image_are_no_nan():
    """A user may debug with `jax_debug_nans`. A ray without a depth has measured nothing, also beside the box."""
    depth = np.full((12, 16), 2.0)
    depth[:, ::4] = 0.0
    box = nbv.Box((-0.1, -0.1, 1.9), (0.1, 0.1, 2.1))
    pose = nbv.Pose(np.eye(3), np.zeros(3))
    with jax.debug_nans(True), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        cloud = nbv.PointCloud.from_depth(depth, nbv.Camera(height=12, width=16), pose, box=box)
    assert not np.asarray(cloud.missed).reshape(12, 16)[:, ::4].any()
