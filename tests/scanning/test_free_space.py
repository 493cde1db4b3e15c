"""Free space against exact rays in float64 and true distances, with thin sheets and sensor noise; its use by the
planner."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_scenes import CAMERA, CENTRE, GRID, HALF, POSE, RADIUS, SEE, SOLIDS, image, in_camera, nodes_of
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import maximum_filter

import jaxnbv as nbv
from jaxnbv.scanning import carve
from jaxnbv.scanning.sdf import Capsule, Cuboid, Sphere

RNG = np.random.default_rng(0)


def segment_meets(name, x, pose):
    """Whether the segment from the camera to x meets the solid, in closed form."""
    start = np.asarray(pose.position, np.float64) - CENTRE
    way = x - CENTRE - start
    if name == "ball":
        nearest = np.clip(-(way @ start) / (way**2).sum(-1), 0.0, 1.0)
        return np.linalg.norm(start + nearest[..., None] * way, axis=-1) < RADIUS
    enter, leave = np.sort(np.stack([(-HALF - start) / way, (HALF - start) / way]), axis=0)
    return np.maximum(enter.max(axis=-1), 0.0) < np.minimum(leave.min(axis=-1), 1.0)


def wholly_free(name, node, radius, camera, pose, in_image=True):
    """Whether the whole ball about each node is before the solid, in front of the camera and in the image. With
    `in_image=False` only the part of the ball in the image counts."""
    shell = np.asarray(nbv.geometry.fibonacci_sphere(80), np.float64)
    ball = node[:, None] + radius[:, None, None] * np.concatenate([np.zeros((1, 3)), shell])
    column, row, ahead = image(ball, camera, pose)
    in_view = (ahead > 0) & (column > 0) & (column < camera.width) & (row > 0) & (row < camera.height)
    free = ~segment_meets(name, ball, pose)
    return ((in_view & free) if in_image else (~in_view | free)).all(axis=1)


def pixel(node, camera, pose):
    """Pixel whose measurement decides on a node."""
    return np.maximum(in_camera(node, pose)[..., 2], 0.0) * 2.0 * math.tan(0.5 * camera.fov) / camera.height


@pytest.mark.parametrize("margin", [0.5, 1.0])
@pytest.mark.parametrize(("name", "slack"), [("ball", 0.15), ("box", 1.5)])
def test_a_marked_node_has_a_free_ball_about_it_and_well_inside_free_space_nodes_are_marked(name, slack, margin):
    """Except for details below a pixel, which are the solid's outline between pixel centres. Only a box has corners
    there."""
    marked = np.asarray(
        SEE(nbv.Carving(margin_voxels=margin), GRID, POSE, nbv.scan(SOLIDS[name], CAMERA, POSE), CAMERA)
    )
    nodes = nodes_of(GRID)
    some = RNG.choice(np.flatnonzero(marked), 1000)
    node = nodes.reshape(-1, 3)[some]
    radius = margin * GRID.spacing - slack * pixel(node, CAMERA, POSE)
    free = wholly_free(name, node, radius, CAMERA, POSE, in_image=False)
    assert free.all(), f"{(~free).sum()} of 1000 marked nodes are not free"

    column, row, ahead = image(nodes, CAMERA, POSE)
    in_image = (ahead > 0) & (column > 0) & (column < CAMERA.width) & (row > 0) & (row < CAMERA.height)
    node = nodes[in_image]
    radius = margin * GRID.spacing + 3.0 * pixel(node, CAMERA, POSE)
    well_inside = np.concatenate(
        [wholly_free(name, node[i : i + 2000], radius[i : i + 2000], CAMERA, POSE) for i in range(0, len(node), 2000)]
    )
    assert well_inside.sum() > 200
    assert marked[in_image][well_inside].mean() > 0.95


def test_a_node_is_marked_only_if_all_rays_near_it_and_their_neighbours_went_on_beyond_it():
    """The definition for each ray in float64, on an image of random depths with holes and misses."""
    grid, camera, margin = nbv.Grid(16, 0.6), nbv.Camera(height=30, width=24, fov=0.5), 0.08
    shape = (camera.height, camera.width)
    depth = np.where(RNG.random(shape) < 0.03, RNG.uniform(1.8, 3.0, shape), np.inf)
    depth[RNG.random(shape) < 0.005] = 0.0
    depth[:, :12] = np.inf
    rays = np.asarray(camera.pixel_directions(), np.float64)
    pose = nbv.look_at((0.3, -0.4, 2.2))
    hit = np.isfinite(depth.ravel()) & (depth.ravel() > 0)
    points = np.asarray(pose.to_scene(jnp.asarray(np.where(hit, depth.ravel(), 0.0)[:, None] * rays, jnp.float32)))
    points = jnp.where(hit[:, None], points, 0.0)
    cloud = nbv.PointCloud(points, jnp.zeros_like(points), jnp.asarray(hit), jnp.asarray(np.isinf(depth.ravel())))
    marked = np.asarray(nbv.Carving(margin_voxels=margin / grid.spacing).empty_nodes(grid, pose, cloud, camera)).ravel()

    local = in_camera(nodes_of(grid).reshape(-1, 3), pose)
    unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    near = np.linalg.norm(np.cross(local[:, None], unit), axis=-1).reshape(-1, *shape) <= margin
    padded = np.pad(near, ((0, 0), (1, 1), (1, 1)))
    near = np.any([padded[:, i : i + shape[0], j : j + shape[1]] for i in range(3) for j in range(3)], axis=0)
    has_ray = near.any(axis=(1, 2))
    stopped = depth < local[:, 2, None, None] + margin - 1e-5
    allowed = has_ray & ~(near & stopped).any(axis=(1, 2))
    assert marked.sum() > 50
    assert (has_ray & ~allowed).sum() > 200
    assert not (marked & ~allowed).any()


FINE, PLAIN = nbv.Grid(40, 0.7), nbv.Camera()
FINE_NODES = jnp.asarray(nodes_of(FINE), jnp.float32)


@jax.jit
def marked_and_inside(centre, radius, half, axis, angle, start, end, direction, target, distance, key):
    """Numbers of nodes that are marked, inside the solid, and both."""
    solid = Cuboid(half).rotate(axis, angle).translate(centre) | Capsule(start, end, radius)
    pose = nbv.look_at(target + distance * direction, target)
    cloud = nbv.SensorNoise()(nbv.scan(nbv.SDFSurface(solid), PLAIN, pose), key)
    empty, inside = nbv.Carving().empty_nodes(FINE, pose, cloud, PLAIN), solid(FINE_NODES) < 0
    return jnp.sum(empty), jnp.sum(inside), jnp.sum(empty & inside)


@pytest.mark.slow
@settings(max_examples=200)
@given(st.integers(0, 2**31))
def test_noise_on_any_solid_from_anywhere_carves_nothing_of_it(seed):
    """Nodes are 0.036 apart, so that the margin is 3.6 standard deviations."""
    rng = np.random.default_rng(seed)
    ends, target = rng.uniform(-0.5, 0.5, (2, 3)), rng.uniform(-0.2, 0.2, 3)
    axis, direction = rng.normal(size=(2, 3))
    direction /= np.linalg.norm(direction)
    half, centre = rng.uniform(0.08, 0.4, 3), rng.uniform(-0.2, 0.2, 3)
    radius, angle, distance = rng.uniform(0.08, 0.2), rng.uniform(0.0, 3.0), rng.uniform(1.3, 2.6)
    floats = (centre, radius, half, axis, angle, *ends, direction, target, distance)
    counts = marked_and_inside(*(jnp.asarray(x, jnp.float32) for x in floats), jax.random.key(seed % 1000))
    marked, inside, both = map(int, counts)
    assert inside > 200
    assert marked > 100
    assert both == 0


BALL_SCAN = nbv.scan(SOLIDS["ball"], CAMERA, POSE)


def with_invalid(cloud, invalid):
    """The scan, with some pixels invalid."""
    keep = jnp.asarray(~invalid)
    points, normals = (jnp.where(keep[:, None], a, 0.0) for a in (cloud.points, cloud.normals))
    return nbv.PointCloud(points, normals, cloud.mask & keep, cloud.missed & keep)


def test_nodes_behind_a_camera_within_the_grid_are_not_seen():
    pose = nbv.look_at((0.1, 0.2, 0.3), (1.0, 0.4, 0.5))
    nothing = jnp.zeros((CAMERA.num_rays, 3))
    missed = jnp.ones(CAMERA.num_rays, bool)
    empty = np.asarray(SEE(nbv.Carving(), GRID, pose, nbv.PointCloud(nothing, nothing, ~missed, missed), CAMERA))
    *_, ahead = image(nodes_of(GRID)[empty], CAMERA, pose)
    assert len(ahead) > 100
    assert ahead.min() > 2.0 * GRID.spacing


def test_a_depth_image_carves_what_the_scan_carves_and_says_which_rays_missed():
    """Pixels of infinity have no return. Zero, negative values, NaN and the depth of a lone pixel are invalid."""
    hit = np.asarray(BALL_SCAN.mask)
    depth = np.where(hit, in_camera(np.asarray(BALL_SCAN.points, np.float64), POSE)[:, 2], np.inf)
    bad = np.zeros(depth.shape, bool)
    bad[[5, 300, 2000]] = True
    depth[[5, 300, 2000]] = 0.0, np.nan, -1.0
    depth[69] = 1.5
    cloud = nbv.PointCloud.from_depth(depth.reshape(CAMERA.height, CAMERA.width), CAMERA, POSE)
    expected = ~hit & ~bad
    expected[69] = False
    np.testing.assert_array_equal(cloud.missed, expected)
    assert not (np.asarray(cloud.mask) & expected).any()
    assert not cloud.mask[69]
    from_depth = np.asarray(SEE(nbv.Carving(), GRID, POSE, cloud, CAMERA))
    from_scan = SEE(nbv.Carving(), GRID, POSE, with_invalid(BALL_SCAN, ~np.asarray(cloud.mask | cloud.missed)), CAMERA)
    assert from_depth.sum() > 1000
    # Depths are rounded, so a node exactly a margin before a hit may have either mark.
    assert (from_depth != np.asarray(from_scan)).sum() <= 3


def test_noise_and_frames_keep_the_rays_that_missed():
    frame = nbv.Frame(0.5, (1.0, 2.0, 3.0))
    for cloud in (nbv.SensorNoise()(BALL_SCAN, jax.random.key(0)), frame.to_scene(frame.to_world(BALL_SCAN))):
        np.testing.assert_array_equal(cloud.missed, ~np.asarray(BALL_SCAN.mask))


def test_the_outside_is_what_lies_a_margin_beyond_the_volume():
    grid, half = nbv.Grid(30), np.array([0.6, 0.9, 1.1])
    carving = nbv.Carving(nbv.Box(tuple((-half).tolist()), tuple(half.tolist())), margin_voxels=0.7)
    beyond = np.maximum(np.abs(nodes_of(grid)) - half, 0.0)
    np.testing.assert_array_equal(carving.outside(grid), np.linalg.norm(beyond, axis=-1) > 2 * 0.7 * grid.spacing)
    in_ball = np.linalg.norm(nodes_of(grid), axis=-1) - 1.0
    np.testing.assert_array_equal(nbv.Carving(Sphere(1.0)).outside(grid), in_ball > 2 * grid.spacing)


def test_carved_values_are_positive_where_empty_and_twice_the_largest_about():
    """On every edge of the grid the rest crosses zero at a third, near the node that was not carved."""
    values = jnp.asarray(RNG.normal(size=(2, 4, 4, 4)), jnp.float32).at[0, 1, 1, 1].set(0.0)
    empty = jnp.asarray(RNG.random((4, 4, 4)) < 0.5).at[1, 1, 1].set(True)
    carved = np.asarray(carve(values, empty))
    assert (carved[:, empty] > 0).all()
    np.testing.assert_array_equal(carved[:, ~empty], values[:, ~empty])
    largest = maximum_filter(np.abs(values), size=(1, 3, 3, 3), mode="nearest")
    np.testing.assert_array_equal(carved[:, empty], 2 * largest[:, empty])
    assert (np.asarray(carve(jnp.zeros((4, 4, 4)), jnp.ones((4, 4, 4), bool))) > 0).all()
