"""Tables, walls and meshes around the object: what they hide, against Embree and float64, and where cameras may
stand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from free_scenes import SEE
from scipy.spatial.transform import Rotation

import jaxnbv as nbv
from jaxnbv.planning.table import other_ups, table_under
from jaxnbv.sampler import StepInputs
from jaxnbv.scanning.sdf import Capsule, Cuboid, HalfSpace, Sphere, solid_of_mesh

CAMERA, BALL = nbv.Camera(height=24, width=24), nbv.SDFSurface(Sphere(0.8))
TABLE = HalfSpace([0.0, -0.5, 0.0], [0.0, 1.0, 0.0])
WALL = Cuboid([0.1, 1.0, 1.0]).translate([1.6, 0.0, 0.0])
POSES = nbv.look_at(np.array([[0.5, -1.8, 1.5], [2.4, 0.3, 0.4], [0.2, 1.9, 1.6]]))
KEY = jax.random.key(3)


def box_mesh(low, high):
    mesh = trimesh.creation.box(bounds=[low, high])
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def rays_of(pose):
    origin = np.asarray(pose.position, np.float64)
    directions = np.asarray(CAMERA.pixel_directions(), np.float64) @ np.asarray(pose.rotation, np.float64).T
    return origin, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def first_hits(vertices, faces, pose):
    """Distance along the camera's rays to a mesh, by Embree. Infinite for a miss."""
    mesh = nbv.TriangleMesh(vertices, faces, nbv.Frame())
    origin, directions = rays_of(pose)
    hits = mesh.trace(np.tile(origin, (len(directions), 1)), directions)
    along = np.linalg.norm(np.asarray(hits.points, np.float64) - origin, axis=1)
    return np.where(hits.mask, along, np.inf)


@pytest.mark.parametrize("index", range(3))
def test_a_table_is_met_where_its_plane_is(index):
    ranges = np.asarray(nbv.Obstacles((TABLE,)).barrier(CAMERA, POSES[index]), np.float64)
    origin, directions = rays_of(POSES[index])
    if origin[1] < -0.5:
        # The pose is within the obstacle, and the hit is the exit.
        assert np.isfinite(ranges).mean() > 0.3
    else:
        along = (-0.5 - origin[1]) / directions[:, 1]
        near = (along > 0) & (np.linalg.norm(origin + along[:, None] * directions, axis=1) < 7.5)
        np.testing.assert_allclose(ranges[near], along[near], rtol=2e-3)
        assert np.isinf(ranges[along < 0]).all()


@pytest.mark.parametrize(("index", "as_mesh"), [(0, False), (1, False), (2, False), (1, True)])
def test_what_a_wall_hides_is_what_embree_says(as_mesh, index):
    """The wall is a box, or a mesh of twelve triangles."""
    low, high = [1.5, -1.0, -1.0], [1.7, 1.0, 1.0]
    mesh = box_mesh(low, high)
    wall = solid_of_mesh(*mesh, resolution=60) if as_mesh else WALL
    pose = POSES[index]
    barrier = nbv.Obstacles((wall,)).barrier(CAMERA, pose)
    expected = first_hits(*mesh, pose)
    ranges = np.asarray(barrier)
    # Rays beside the edges may differ, since distances of meshes are sampled on cells.
    same = np.isfinite(ranges) == np.isfinite(expected)
    assert same.mean() > (0.95 if as_mesh else 0.99)
    both = np.isfinite(ranges) & np.isfinite(expected)
    assert np.abs(ranges[both] - expected[both]).max(initial=0.0) < (0.15 if as_mesh else 2e-3)
    hidden, alone = nbv.scan(BALL, CAMERA, pose, barrier), nbv.scan(BALL, CAMERA, pose)
    away = np.linalg.norm(np.asarray(alone.points, np.float64) - np.asarray(pose.position), axis=1)
    visible = np.asarray(alone.mask) & (away < expected)
    assert (np.asarray(hidden.mask) == visible).mean() > (0.95 if as_mesh else 0.99)
    np.testing.assert_array_equal(hidden.missed, ~np.asarray(hidden.mask))
    np.testing.assert_array_equal(hidden.points[~np.asarray(hidden.mask)], 0.0)


def test_solids_of_meshes_have_the_distances_of_their_formulas():
    ball = trimesh.creation.icosphere(4, radius=0.7)
    solid = solid_of_mesh(ball.vertices, ball.faces, resolution=50)
    x = np.random.default_rng(0).uniform(-2.0, 2.0, (400, 3))
    exact = np.linalg.norm(x, axis=1) - 0.7
    distances = np.asarray(solid(jnp.asarray(x, jnp.float32)))
    within = np.abs(x).max(axis=1) < 0.8
    np.testing.assert_allclose(distances[within], exact[within], atol=0.03)
    assert np.all(distances[~within] <= exact[~within] + 0.03)
    assert np.all(distances[~within] > 0)


def test_points_of_obstacles_are_not_the_objects():
    points = np.array([[0.0, -0.49, 0.3], [0.0, -0.4, 0.3], [0.1, 0.2, 0.3]])
    normals = np.tile([0.0, 1.0, 0.0], (3, 1))
    cloud = nbv.PointCloud.from_arrays(points, normals, 4)
    scanned = nbv.PointCloud(cloud.points, cloud.normals, cloud.mask, jnp.array([False, False, False, True]))
    rest = nbv.Obstacles((TABLE,), margin=0.05).remove_points(scanned)
    np.testing.assert_array_equal(rest.mask, [False, True, True, False])
    np.testing.assert_array_equal(rest.missed, [True, False, False, True])
    np.testing.assert_array_equal(rest.points[0], 0.0)


def test_space_is_seen_empty_up_to_an_obstacle():
    """Every ray misses the ball. Nodes before the wall are empty, and nodes behind it are unknown."""
    grid, pose = nbv.Grid(40), nbv.look_at((-2.4, 0.0, 0.0))
    nothing = nbv.scan(nbv.SDFSurface(Sphere(0.01).translate([0.0, 5.0, 0.0])), CAMERA, pose)
    wall = nbv.Obstacles((Cuboid([0.1, 2.0, 2.0]).translate([0.5, 0.0, 0.0]),))
    barrier = wall.barrier(CAMERA, pose)
    free, limited = (np.asarray(SEE(nbv.Carving(), grid, pose, nothing, CAMERA, b)) for b in (None, barrier))
    x = np.asarray(grid.axis)
    middle = 20
    assert free[(x > 0.6) & (x < 1.2), middle, middle].all()
    assert not limited[x > 0.4].any()
    np.testing.assert_array_equal(limited[x < 0.4 - 2.5 * grid.spacing], free[x < 0.4 - 2.5 * grid.spacing])


def planner_of(search, obstacles):
    sampler = nbv.SurfaceSampler(nbv.GeometricSPSR(0.1, truncation=8), nbv.Grid(28), 3)
    camera = nbv.Camera(height=12, width=12)
    return nbv.Planner(nbv.Coverage(), search, camera, sampler, obstacles=obstacles, capacity=256, max_views=6)


def test_an_episode_stands_and_sees_above_the_table():
    planner = planner_of(nbv.FarthestView(40), nbv.Obstacles((TABLE,), clearance=0.3))
    first, exact = nbv.look_at((0.5, 0.8, 2.2)), nbv.SensorNoise(0.0, 0.0)
    episode = nbv.simulate(planner, BALL, first, 4, KEY, exact, progress=False)
    for view in episode.views:
        assert float(view.pose.position[1]) > -0.2
        assert np.asarray(view.scan.points)[np.asarray(view.scan.mask), 1].min(initial=0.0) > -0.501
    below = np.asarray(planner.search.candidates.poses().position)[:, 1] < -0.2
    for view in episode.views[1:]:
        assert np.isneginf(np.asarray(view.proposal.values)[below]).all()


@pytest.mark.slow
def test_a_search_by_gradient_stays_out_of_obstacles():
    """All starts are too low, and ascent without obstacles stays there."""
    starts = nbv.look_at(2.3 * np.array([[np.cos(a), -0.05, np.sin(a)] for a in (0.3, 1.9, 3.5, 5.1)]))
    search = nbv.GradientSearch(dof=2, num_starts=4, iterations=12, learning_rate=0.05, candidates=starts)
    table = HalfSpace([0.0, -0.2, 0.0], [0.0, 1.0, 0.0])
    planner = planner_of(search, nbv.Obstacles((table,), clearance=0.4))
    proposal = planner.propose(planner.init(POSES[2], nbv.scan(BALL, planner.camera, POSES[2])), KEY)
    assert float(proposal.pose.position[1]) >= 0.2 - 1e-5
    assert np.isneginf(np.asarray(proposal.values)).all()
    heights = np.asarray(proposal.trajectories.poses.position)[..., 1]
    assert (heights[:, -1] > heights[:, 0]).all()


def test_from_the_world_to_the_scene():
    """Distances in the world times the scale equal those in the scene."""
    frame = nbv.Frame.fit(np.array([[0.1, 0.2, 0.0], [0.4, 0.5, 0.25]]), up="z")
    table, block = HalfSpace([0.0, 0.0, 0.01], [0.0, 0.0, 1.0]), Cuboid([0.05, 0.1, 0.2]).translate([0.6, 0.0, 0.2])
    world = nbv.Obstacles((table, block), margin=0.01, clearance=0.05)
    scene = world.in_scene(frame)
    x = np.random.default_rng(0).uniform(-0.5, 1.0, (100, 3))
    places = jnp.asarray(frame.to_scene(x), jnp.float32)
    np.testing.assert_allclose(scene.distance(places), frame.scale * np.asarray(world.distance(x)), atol=1e-4)
    assert scene.clearance == pytest.approx(frame.scale * 0.05)
    assert scene.margin == pytest.approx(frame.scale * 0.01)


BOX = nbv.Box((-0.5, -0.25, -1.25), (0.5, 1.2, 1.25))


def level_board(rng, half, height, count=800):
    """Points of a board across the y axis, with a little noise."""
    points = rng.uniform(-1.0, 1.0, (count, 3)) * [half[0], 0.0, half[1]] + [0.0, height, 0.0]
    return points + rng.normal(0.0, 0.005, points.shape)


def under(*parts):
    points = np.concatenate(parts)
    return table_under(nbv.PointCloud.from_arrays(points, np.tile([0.0, 1.0, 0.0], (len(points), 1))), BOX)


@pytest.mark.parametrize("seed", range(4))
def test_what_an_object_stands_on_is_found(seed):
    """The board is in the box or a little below it, with a tilt of up to 10 degrees."""
    rng = np.random.default_rng(seed)
    turn = Rotation.from_euler("xz", rng.uniform(-0.12, 0.12, 2)).as_matrix()
    height = rng.uniform(-0.3, -0.05)
    table = level_board(rng, (2.0, 2.0), 0.0) @ turn.T + [0.0, height, 0.0]
    thing = np.array([0.0, height + 0.55, 0.0]) + rng.uniform(-0.4, 0.4, (400, 3))
    (plane,) = under(thing, table).solids
    assert np.asarray(plane.normal) @ turn[:, 1] > np.cos(np.radians(0.5))
    assert abs(float(plane(jnp.asarray([0.0, height, 0.0])))) < 0.01


@pytest.mark.parametrize(
    "parts",
    [
        lambda rng: [level_board(rng, (0.45, 1.2), 0.4)],
        lambda rng: [level_board(rng, (0.45, 1.2), 1.0), level_board(rng, (2.0, 2.0), -1.5)],
        lambda rng: [level_board(rng, (2.0, 2.0), 0.3), rng.uniform(-0.4, 0.0, (200, 3))],
        lambda rng: [level_board(rng, (2.0, 2.0), 0.0)[:, [1, 0, 2]], rng.uniform(0.1, 0.4, (200, 3))],
        lambda rng: [rng.uniform(-0.4, 0.4, (30, 3))],
    ],
    ids=["a table that is the object", "the top of a box", "things below", "a wall", "few points"],
)
def test_points_of_no_support_are_kept(parts):
    assert under(*parts(np.random.default_rng(0))) is None


SEEN_BY = nbv.Camera(fov=0.75, height=120, width=160)


def carton_before_a_wall(rng, size, tilt, gap, table=True):
    """An image of a block on a table with a wall behind it at a gap, all turned by a tilt, in closed form with noise of
    1.5 mm at 1 m. Also returns the pose, the block's corners and the table's normal."""
    axis = rng.normal(size=2)
    turn = Rotation.from_rotvec(np.radians(tilt) * np.array([*axis, 0.0]) / np.linalg.norm(axis)).as_matrix()
    angle, elevation, distance = rng.uniform(-1.0, 1.0), rng.uniform(0.25, 1.1), rng.uniform(0.45, 0.8)
    place = np.array([np.cos(elevation) * np.sin(angle), -np.cos(elevation) * np.cos(angle), np.sin(elevation)])
    middle = np.array([0.0, 0.0, 0.5 * size[2]])
    pose = nbv.look_at(turn @ (middle + distance * place), turn @ middle, up=turn[:, 2])
    directions = np.asarray(SEEN_BY.pixel_directions(), np.float64) @ np.asarray(pose.rotation, np.float64).T @ turn
    origin = np.asarray(pose.position, np.float64) @ turn
    half = 0.5 * np.array(size)
    with np.errstate(divide="ignore"):
        enter, leave = np.sort([(sign * half + middle - origin) / directions for sign in (-1.0, 1.0)], axis=0)
        depth = np.where(enter.max(axis=1) < leave.min(axis=1), enter.max(axis=1), np.inf)
        on_table = -origin[2] / directions[:, 2]
        behind = (half[1] + gap - origin[1]) / directions[:, 1]
    at = origin + on_table[:, None] * directions
    hit = (on_table > 0) & (np.abs(at[:, 0]) < 0.4) & (at[:, 1] > -0.5) & table
    depth = np.minimum(depth, np.where(hit, on_table, np.inf))
    depth = np.minimum(depth, np.where(behind > 0, behind, np.inf))
    depth = np.where(depth < 3.0, depth, 0.0)
    image = (depth + 0.0015 * depth**2 * rng.normal(size=depth.shape)).reshape(120, 160)
    corners = np.stack(np.meshgrid(*zip(-half, half, strict=True)), axis=-1).reshape(-1, 3) + middle
    return image, pose, corners @ turn.T, turn[:, 2]


SIZES = {"carton": (0.3, 0.22, 0.2), "book on edge": (0.17, 0.03, 0.24)}


@pytest.mark.parametrize("tilt", [0.0, 20.0])
@pytest.mark.parametrize("size", SIZES.values(), ids=SIZES)
def test_a_table_before_a_wall_is_found_from_any_side(size, tilt):
    """In all views, whatever margin the box has. The plane is within 0.5 degrees and 1.5 mm of the true one."""
    rng = np.random.default_rng(5)
    for room in (0.003, 0.06):
        for gap in (0.02, 0.1):
            image, pose, corners, normal = carton_before_a_wall(rng, size, tilt, gap)
            low, high = corners.min(axis=0) - room, corners.max(axis=0) + room
            frame = nbv.Frame.fit(np.array([low, high]), up="z")
            cloud = nbv.PointCloud.from_depth(image, SEEN_BY, pose, stride=2)
            table = table_under(frame.to_scene(cloud), frame.to_scene(nbv.Box(tuple(low), tuple(high))))
            (plane,) = table.solids
            assert frame.rotation.T @ np.asarray(plane.normal) @ normal > np.cos(np.radians(0.5))
            at = frame.to_scene(np.zeros(3))
            assert abs(float(plane(jnp.asarray(at, jnp.float32)))) / frame.scale < 0.0015


def test_a_wall_is_no_table_and_a_wrong_axis_is_named():
    """A block in the air before a wall, and a block on a table with a wrong upward axis."""
    rng = np.random.default_rng(6)
    for _ in range(2):
        for table in (False, True):
            image, pose, corners, _ = carton_before_a_wall(rng, SIZES["carton"], 0.0, 0.4, table)
            low, high = corners.min(axis=0) - 0.01, corners.max(axis=0) + 0.01
            box = nbv.Box(tuple(low), tuple(high))
            frame = nbv.Frame.fit(np.array([low, high]), up="z")
            cloud = nbv.PointCloud.from_depth(image, SEEN_BY, pose, stride=2)
            assert (table_under(frame.to_scene(cloud), frame.to_scene(box)) is not None) == table
            assert other_ups(cloud, box, "y") == (("z",) if table else ())


def test_no_proposal_is_inside_or_under_what_is_known():
    """200 random scenes of a slanted table, a block, a capsule for an arm, and a few scanned points. Distances come
    from the definitions, in float64."""
    camera, clearance = nbv.Camera(height=4, width=4), 0.15
    poses = jax.tree.map(
        lambda *rows: jnp.concatenate(rows), *(nbv.SphereCandidates(60, radius=r).poses() for r in (0.6, 1.2, 2.4))
    )
    search = nbv.RandomView(nbv.GivenPoses(poses))

    @jax.jit
    def chosen(solids, cloud, key):
        (point, normal), (half, block), (start, end) = solids
        arm = Capsule(start, end, 0.1)
        around = nbv.Obstacles((HalfSpace(point, normal), Cuboid(half).translate(block), arm), clearance=clearance)
        observations = nbv.Observations.start(cloud, 2, None)
        proposal = search.propose(nbv.search.Problem(StepInputs(observations), camera, nbv.Coverage(), around), key)
        return proposal.pose.position, proposal.value

    rng, looked, x = np.random.default_rng(0), 0, np.asarray(poses.position, np.float64)
    for _ in range(200):
        point, normal = rng.uniform(-0.6, 0.2, 3) * [0, 1, 0], rng.normal([0.0, 1.0, 0.0], [0.2, 0.0, 0.2])
        half, block = rng.uniform(0.1, 0.5, 3), rng.uniform(-1.5, 1.5, 3)
        start, end = rng.uniform(-2.0, 2.0, (2, 3))
        points = rng.uniform(-1.0, 1.0, (20, 3))
        cloud = nbv.PointCloud.from_arrays(points, np.tile([0.0, 1.0, 0.0], (20, 1)))
        solids = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), ((point, normal), (half, block), (start, end)))
        place, value = (np.asarray(a, np.float64) for a in chosen(solids, cloud, jax.random.key(rng.integers(1 << 30))))
        assert np.isfinite(value)
        table = (place - point) @ normal / np.linalg.norm(normal)
        outside = np.abs(place - block) - half
        to_block = np.linalg.norm(np.maximum(outside, 0.0)) + min(outside.max(), 0.0)
        share = np.clip((place - start) @ (end - start) / ((end - start) @ (end - start)), 0.0, 1.0)
        to_arm = np.linalg.norm(place - start - share * (end - start)) - 0.1
        to_seen = np.linalg.norm(points - place, axis=1).min()
        assert min(table, to_block, to_arm, to_seen) >= clearance - 1e-4
        looked += ((x - point) @ normal < 0).mean()
    assert 40 < looked < 160
