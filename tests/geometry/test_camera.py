"""Cameras with any intrinsics against the pinhole formula in float64, with range and incidence; poses, `look_at`,
matrices and the Fibonacci sphere."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import jaxnbv as nbv
from jaxnbv.scanning.sdf import Cuboid, Sphere
from jaxnbv.viz.scene import frustum

coordinate = st.floats(-3.0, 3.0, width=32)
vector = st.tuples(coordinate, coordinate, coordinate)
# Few sizes, since each is compiled.
sizes = st.sampled_from([2, 7, 60])
lengths = st.floats(5.0, 500.0)
shares = st.floats(0.05, 0.95)
matrices = st.tuples(sizes, sizes, lengths, lengths, shares, shares)


def camera_and_matrix(given):
    width, height, fx, fy, x, y = given
    matrix = np.array([[fx, 0.0, x * width - 0.5], [0.0, fy, y * height - 0.5], [0.0, 0.0, 1.0]])
    return nbv.Camera.from_intrinsics(matrix, height, width), matrix


@settings(max_examples=30)
@given(matrices)
def test_rays_go_through_the_pixels_of_the_intrinsic_matrix(values):
    camera, matrix = camera_and_matrix(values)
    directions = np.asarray(camera.pixel_directions(), np.float64)
    pixels = directions @ matrix.T
    column, row = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    np.testing.assert_allclose(pixels[:, 0], column.ravel(), atol=1e-3)
    np.testing.assert_allclose(pixels[:, 1], row.ravel(), atol=1e-3)
    np.testing.assert_allclose(camera.intrinsics, matrix, rtol=1e-6, atol=1e-5)
    np.testing.assert_allclose(camera.to_pixels(directions[:, :2]), pixels[:, :2] + 0.5, atol=2e-3)


@settings(max_examples=30)
@given(matrices, st.integers(1, 7))
def test_a_strided_camera_has_the_rays_of_every_nth_pixel(values, stride):
    camera, _ = camera_and_matrix(values)
    rows = slice(stride // 2, None, stride)
    every = np.asarray(camera.pixel_directions()).reshape(camera.height, camera.width, 3)[rows, rows]
    if every.size == 0:
        with pytest.raises(nbv.InputError, match=f"stride of {stride} leaves none"):
            camera.strided(stride)
        return
    strided = camera.strided(stride)
    assert (strided.height, strided.width) == every.shape[:2]
    np.testing.assert_allclose(strided.pixel_directions(), every.reshape(-1, 3), rtol=1e-4, atol=1e-5)


@settings(max_examples=30)
@given(matrices, sizes, sizes)
def test_a_resized_camera_sees_the_same_and_the_frustum_is_its_border(values, height, width):
    camera, matrix = camera_and_matrix(values)
    resized = camera.resized(height, width)
    assert (resized.height, resized.width) == (height, width)
    np.testing.assert_allclose(resized.edges, camera.edges, rtol=1e-5)
    expected = [
        (-0.5 - matrix[0, 2]) / matrix[0, 0],
        (-0.5 - matrix[1, 2]) / matrix[1, 1],
        (camera.width - 0.5 - matrix[0, 2]) / matrix[0, 0],
        (camera.height - 0.5 - matrix[1, 2]) / matrix[1, 1],
    ]
    np.testing.assert_allclose(camera.edges, expected, rtol=1e-5, atol=1e-7)
    corners = frustum(nbv.Pose(np.eye(3), np.zeros(3)), camera, 2.0)[:4, 1]
    np.testing.assert_allclose(corners[0], [2 * expected[0], 2 * expected[1], 2.0], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(corners[2], [2 * expected[2], 2 * expected[3], 2.0], rtol=1e-5, atol=1e-6)


FULL = np.array([[600.0, 0.0, 318.6], [0.0, 605.0, 242.3], [0.0, 0.0, 1.0]])
# Principal points of depth cameras on the market, as shares of width and height.
CENTERS = [(0.4978, 0.5318), (0.5, 0.5), (0.4863, 0.4961), (0.516, 0.49)]


@pytest.mark.parametrize(("left", "top"), [(320, 240), (600, 0), (-300, 100), (0, 400), (100, -200)])
def test_the_rays_of_a_window_are_those_of_the_whole_image(left, top):
    """For principal points anywhere, even outside the image, as of structured light."""
    matrix, whole = FULL - np.array([[0.0, 0.0, left], [0.0, 0.0, top], [0.0, 0.0, 0.0]]), np.array(FULL)
    camera = nbv.Camera.from_intrinsics(matrix, 120, 160)
    directions = np.asarray(camera.pixel_directions(), np.float64).reshape(120, 160, 3)
    pixels = directions @ whole.T
    np.testing.assert_allclose(pixels[0, 0, :2], [left, top], atol=1e-3)
    np.testing.assert_allclose(pixels[-1, -1, :2], [left + 159, top + 119], atol=1e-3)


@pytest.mark.parametrize("binning", [2, 3, 4])
@pytest.mark.parametrize("center", CENTERS)
def test_a_matrix_of_another_image_size_is_named(center, binning, recwarn):
    height, width, matrix = 480, 640, np.array(FULL)
    matrix[:2, 2] = center[0] * width - 0.5, center[1] * height - 0.5
    nbv.Camera.from_intrinsics(matrix, height, width)
    assert len(recwarn) == 0
    named = r"centre of an image of 6\d\d x [45]\d\d, but this one is .* binned.* divide its first two rows by"
    with pytest.raises(nbv.InputError, match=f"{named} {binning}"):
        nbv.Camera.from_intrinsics(matrix, height // binning, width // binning)
    if binning == 2:
        with pytest.warns(UserWarning, match=r"centre of an image .* divide its first two rows by 0\.5"):
            nbv.Camera.from_intrinsics(matrix, height * 2, width * 2)
    right = np.array(matrix)
    right[:2] /= binning
    nbv.Camera.from_intrinsics(right, height // binning, width // binning)


LENSES = [
    (-0.3, 0.1, 0.001, -0.002),
    (0.1, -0.2, 0.0005, 0.0005, 0.1),
    (8.1, 4.5, 1e-4, -2e-5, 0.2, 8.4, 6.5, 1.2),
]


def through_lens(x, y, k1, k2, p1, p2, k3=0.0, k4=0.0, k5=0.0, k6=0.0):
    """OpenCV's formula in float64."""
    r2 = x * x + y * y
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    return x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y


@pytest.mark.parametrize("lens", LENSES)
def test_distortion_is_undone_once_an_image(lens):
    """A ball before a slanted wall through a lens. Analytic depths on rays from the inverted forward model. Pixels
    without a return keep none."""
    matrix = np.array([[250.0, 0.0, 160.5], [0.0, 252.0, 118.0], [0.0, 0.0, 1.0]])
    v, u = np.mgrid[:240, :320].astype(float)
    bent = (u - 160.5) / 250.0, (v - 118.0) / 252.0
    x, y = np.array(bent)
    for _ in range(100):
        now = through_lens(x, y, *lens)
        x, y = x + bent[0] - now[0], y + bent[1] - now[1]
    np.testing.assert_allclose(through_lens(x, y, *lens), bent, atol=1e-9)
    center, radius = np.array([0.05, -0.02, 0.55]), 0.15
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    a, b, c = (rays**2).sum(axis=-1), rays @ center, center @ center - radius**2
    root = b * b - a * c
    ball = np.where(root > 0, (b - np.sqrt(np.maximum(root, 0.0))) / a, np.inf)
    depth = np.where(x > 0.3, np.inf, np.minimum(ball, 0.8 / (1.0 - 0.1 * x)))
    camera = nbv.Camera.from_intrinsics(matrix, 240, 320, distortion=lens)
    pose = nbv.Pose(np.eye(3), np.zeros(3))
    clouds, off = [], []
    for one in (camera, nbv.Camera.from_intrinsics(matrix, 240, 320)):
        cloud = nbv.PointCloud.from_depth(depth, one, pose, stride=2)
        clouds.append(cloud)
        points = np.asarray(cloud.to_numpy()[0], np.float64)
        from_ball = np.linalg.norm(points - center, axis=1) - radius
        from_wall = (points[:, 2] - 0.1 * points[:, 0] - 0.8) / math.hypot(1.0, 0.1)
        off.append(np.minimum(np.abs(from_ball), np.abs(from_wall)))
    assert np.median(off[0]) < 5e-5
    assert np.percentile(off[0], 99) < 1e-3
    assert np.median(off[1]) > 4 * np.percentile(off[0], 90)
    cloud = clouds[0]
    missed, met = np.asarray(cloud.missed), np.asarray(cloud.mask)
    across = np.asarray(camera.strided(2).pixel_directions())[:, 0]
    assert not missed[across < 0.295].any()
    assert not met[across > 0.305].any()
    assert missed[across > 0.305].mean() > 0.6
    on_ball = np.abs(np.linalg.norm(np.asarray(cloud.points) - center, axis=1) - radius) < 1e-4
    outward = (np.asarray(cloud.points)[met & on_ball] - center) / radius
    assert np.median(np.sum(outward * np.asarray(cloud.normals)[met & on_ball], axis=1)) > math.cos(math.radians(2.0))


def test_a_scan_tells_what_lies_in_range_and_is_not_aslant():
    """A ball before a wall, with analytic depths and angles at each ray."""
    surface = nbv.SDFSurface(Sphere(0.5) | Cuboid([1.2, 1.2, 0.1]).translate([0.0, 0.0, -1.0]))
    pose = nbv.look_at((0.0, 0.0, 2.5))
    whole = nbv.Camera(math.radians(50.0), 40, 40)
    every = nbv.scan(surface, whole, pose)
    depth = 2.5 - np.asarray(every.points)[:, 2]
    _, rays = whole.rays(pose)
    cosine = -np.sum(np.asarray(every.normals) * np.asarray(rays), axis=1)
    hit = np.asarray(every.mask)
    limited = nbv.Camera(math.radians(50.0), 40, 40, nearest=2.1, farthest=3.0, max_incidence=math.radians(60.0))
    scanned = nbv.scan(surface, limited, pose)
    expected = hit & (depth >= 2.1) & (depth <= 3.0) & (cosine >= 0.5)
    for share in (expected, hit & (depth < 2.1), hit & (depth > 3.0), hit & (depth < 3.0) & (cosine < 0.5)):
        assert 10 < share.sum() < 1500
    np.testing.assert_array_equal(scanned.mask, expected)
    np.testing.assert_array_equal(scanned.missed, ~hit | (hit & (depth > 3.0)))
    np.testing.assert_array_equal(np.asarray(scanned.points)[expected], np.asarray(every.points)[expected])
    assert not np.asarray(scanned.points)[~expected].any()


def test_rays_of_a_limited_sensor_are_empty_up_to_its_range():
    grid, pose, see = nbv.Grid(24), nbv.look_at((0.0, 0.0, 2.5)), eqx.filter_jit(nbv.Carving.empty_nodes)
    nothing = nbv.SDFSurface(Sphere(0.01).translate([0.0, 1.4, 0.0]))
    masks = {
        farthest: np.asarray(see(nbv.Carving(), grid, pose, nbv.scan(nothing, camera, pose), camera))
        for farthest, camera in ((far, nbv.Camera(0.9, 48, 48, farthest=far)) for far in (2.5, None))
    }
    deep = 2.5 - grid.axis
    assert masks[None].any(axis=(0, 1))[deep > 3.0].any()
    assert not masks[2.5].any(axis=(0, 1))[deep > 2.5 - grid.spacing].any()
    near = masks[2.5].any(axis=(0, 1))[deep < 2.5 - 2 * grid.spacing]
    np.testing.assert_array_equal(near, masks[None].any(axis=(0, 1))[deep < 2.5 - 2 * grid.spacing])


rotations = st.tuples(st.integers(0, 2**32 - 1), st.lists(st.floats(-3, 3, width=32), min_size=3, max_size=3))


@settings(max_examples=30)
@given(rotations)
def test_poses_to_matrices_and_back_in_both_conventions(given):
    seed, position = given
    rotation = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, position
    np.testing.assert_allclose(nbv.Pose.from_matrix(matrix).matrix, matrix, atol=1e-6)
    # A camera of OpenGL looks along its own -z, and its y is up.
    turned = nbv.Pose.from_matrix(matrix, "opengl")
    np.testing.assert_allclose(turned.forward, -rotation[:, 2], atol=1e-6)
    np.testing.assert_allclose(turned.rotation[:, 1], -rotation[:, 1], atol=1e-6)
    np.testing.assert_allclose(turned.rotation[:, 0], rotation[:, 0], atol=1e-6)
    pose = nbv.Pose.from_matrix(np.stack([matrix, np.eye(4)]))[0]
    points = np.random.default_rng(0).normal(size=(5, 3))
    np.testing.assert_allclose(
        pose.to_scene(jnp.asarray(points, jnp.float32)), points @ rotation.T + position, atol=1e-5
    )


def test_a_matrix_to_three_digits_is_made_a_rotation():
    matrices = np.tile(np.eye(4), (50, 1, 1))
    matrices[:, :3, :3] = Rotation.random(50, rng=np.random.default_rng(0)).as_matrix()
    poses = nbv.Pose.from_matrix(np.round(matrices, 3))
    rotation = np.asarray(poses.rotation, np.float64)
    np.testing.assert_allclose(rotation, matrices[:, :3, :3], atol=1e-3)
    off = np.abs(rotation @ rotation.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2))
    given = np.round(matrices[:, :3, :3], 3)
    was_off = np.abs(given @ given.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2)) > 1e-3
    assert 5 < was_off.sum() < 50
    assert off[was_off].max() < 1e-6


@settings(max_examples=60)
@given(vector, vector, vector)
def test_look_at_is_a_rotation_that_faces_its_target_with_up_above(position, target, up):
    position, target, up = (np.asarray(v, dtype=np.float32).astype(np.float64) for v in (position, target, up))
    offset = target - position
    assume(np.linalg.norm(offset) > 0.1)
    assume(np.linalg.norm(up) > 0.1)
    pose = nbv.look_at(position, target, up)
    rotation = np.asarray(pose.rotation, dtype=np.float64)
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-5)
    assert np.linalg.det(rotation) == pytest.approx(1.0, abs=1e-5)
    right, down, forward = rotation.T
    np.testing.assert_allclose(forward, offset / np.linalg.norm(offset), atol=1e-5)
    sine = np.linalg.norm(np.cross(forward, up)) / np.linalg.norm(up)
    if sine > 0.01:
        assert down @ up < 0
        assert abs(right @ up) < 1e-4 * np.linalg.norm(up)


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("tilt", [0.0, 1e-7, 1e-5, 1e-3])
def test_looking_along_up_is_defined(side, tilt):
    rotation = np.asarray(nbv.look_at((tilt, 2.5 * side, 0.0)).rotation)
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-5)
    np.testing.assert_allclose(rotation[:, 2], [-tilt / 2.5, -side, 0.0], atol=1e-5)
    assert np.linalg.det(rotation) == pytest.approx(1.0, abs=1e-5)


def test_look_at_and_rays_run_under_jit_and_are_differentiable():
    camera = nbv.Camera(height=2, width=3)

    def last_ray(position):
        return camera.rays(nbv.look_at(position))[1][-1]

    position = jnp.array([0.8, 0.9, 2.2])
    np.testing.assert_allclose(jax.jit(last_ray)(position), last_ray(position), atol=1e-6)
    jacobian = jax.jacobian(last_ray)(position)
    for i in range(3):
        step = jnp.zeros(3).at[i].set(1e-2)
        difference = (last_ray(position + step) - last_ray(position - step)) / 2e-2
        np.testing.assert_allclose(jacobian[:, i], difference, atol=1e-4)


@pytest.mark.parametrize("count", [12, 120, 1000])
def test_fibonacci_sphere_is_even(count):
    """Distances between nearest neighbours against Fejes Toth's bound, which no set of n points on the sphere can
    exceed."""
    points = np.asarray(nbv.geometry.fibonacci_sphere(count, 2.5), dtype=np.float64)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 2.5, atol=1e-5)
    unit = points / 2.5
    distance = np.linalg.norm(unit[:, None] - unit[None], axis=-1) + 9 * np.eye(count)
    bound = math.sqrt(4 - 1 / math.sin(math.pi * count / (6 * (count - 2))) ** 2)
    assert 0.8 * bound < distance.min() <= bound
    assert np.linalg.norm(unit.mean(axis=0)) < 2 / count
    # There is no hole: any direction has a point within the distance of neighbours at the bound.
    probes = np.random.default_rng(1).normal(size=(2000, 3))
    probes /= np.linalg.norm(probes, axis=1, keepdims=True)
    assert np.linalg.norm(probes[:, None] - unit[None], axis=-1).min(axis=1).max() < bound


def test_a_batch_of_poses_is_iterated_once():
    poses = nbv.look_at(nbv.geometry.fibonacci_sphere(3, 2.5))
    for pose, again in zip(poses, [poses[0], poses[1], poses[-1]], strict=True):
        np.testing.assert_array_equal(pose.position, again.position)
    assert [len(list(row)) for row in nbv.look_at(np.ones((2, 3, 3)))] == [3, 3]


def test_a_program_for_one_range_runs_for_any():
    """A session's range is in scene units, which depend on its box."""
    traces = []

    @eqx.filter_jit
    def measures(camera, depth):
        traces.append(camera.limited)
        strided = camera.strided(2)
        return (depth >= strided.nearest) & (depth <= strided.farthest)

    depth = jnp.array([0.1, 0.25, 1.0, 2.5, 4.0])
    for nearest, farthest in ((0.2, 2.0), (0.3, 3.0), (0.05, 9.0)):
        camera = nbv.Camera(height=4, width=4, nearest=nearest, farthest=farthest)
        expected = (np.asarray(depth) >= nearest) & (np.asarray(depth) <= farthest)
        np.testing.assert_array_equal(measures(camera, depth), expected)
    assert traces == [True]
    assert not nbv.Camera().limited
