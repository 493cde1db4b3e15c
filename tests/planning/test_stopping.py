"""Stop rules on scripted answers, and expected coverage against an independent count."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from on_grid import balls
from scipy.spatial import cKDTree

from jaxnbv.acquisition import ExpectedUtilityImprovement
from jaxnbv.checks import InputError
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.pose import fibonacci_sphere, look_at
from jaxnbv.observations import Observations
from jaxnbv.planning.part_rules import Identified, PartsFound, Placed
from jaxnbv.planning.planner import Planner
from jaxnbv.planning.simulate import simulate
from jaxnbv.planning.stopping import Budget, Covered, StopContext, Sure, ValueBelow, expected_coverage
from jaxnbv.sampler import SurfaceSampler
from jaxnbv.scanning import Grid, SDFSurface, SensorNoise, scan
from jaxnbv.scanning.sdf import Sphere
from jaxnbv.search import DiscreteSearch, FarthestView
from jaxnbv.surfaces import GeometricSPSR
from jaxnbv.tasks import Coverage, CrossEntropy, EntropyReduction, NewSurface, SoftPartCount

SCENE, FIRST, KEY = SDFSurface(Sphere(0.8)), look_at((0.0, 0.0, 2.5)), jax.random.key(3)
CAMERA, GRID = Camera(height=12, width=12), Grid(24)
SEARCH = DiscreteSearch(10)


def planner_of(acquisition, search=SEARCH):
    sampler = SurfaceSampler(GeometricSPSR(0.2, truncation=6), GRID, num_samples=2)
    return Planner(acquisition, search, CAMERA, sampler, capacity=256, max_views=8)


def cloud_of(count, capacity=256):
    directions = np.asarray(fibonacci_sphere(count))
    return PointCloud.from_arrays(0.8 * directions, directions, capacity)


def after(planner, cloud, poses=(FIRST,), seconds=0.0, frame=Frame(), surfaces=None):  # noqa: B008
    observations = Observations.start(cloud, 4, GRID)
    return StopContext(planner, observations, poses, seconds, KEY, lambda: surfaces, frame)


def of_count(cloud, enough):
    """A class that is certain from `enough` points on, and undecided below."""
    sure = jnp.log(jnp.array([0.99, 0.01]))
    return jnp.where(cloud.count >= enough, sure, jnp.log(jnp.array([0.5, 0.5])))


def of_half(cloud):
    """A class that every half of the points tells, but not always the same class."""
    left = jnp.sum(jnp.where(cloud.mask, jnp.sign(cloud.points[:, 0]), 0.0)) > 0
    return jnp.where(left, jnp.log(jnp.array([0.99, 0.01])), jnp.log(jnp.array([0.01, 0.99])))


@pytest.mark.parametrize(
    ("score", "enough", "rule", "stops"),
    [
        (EntropyReduction, 1, Sure(0.95, 8), True),
        (CrossEntropy, 200, Sure(0.95, 8), False),
        (CrossEntropy, 200, Sure(0.95, 0), True),
        (CrossEntropy, 201, Sure(0.95, 0), False),
        (CrossEntropy, 1, Sure(0.98), True),
        (CrossEntropy, 1, Sure(0.995), False),
    ],
)
def test_sure_classifies_the_cloud_and_its_halves(score, enough, rule, stops):
    planner = planner_of(score(functools.partial(of_count, enough=enough)))
    reason = rule.after(after(planner, cloud_of(200)))
    assert (reason is not None) == stops
    if stops:
        assert reason.startswith("sure of class 0 (99 %")


def test_sure_needs_the_same_class_from_every_half():
    planner = planner_of(CrossEntropy(of_half))
    assert Sure(0.95, 0).after(after(planner, cloud_of(199))) is not None
    assert Sure(0.95, 16).after(after(planner, cloud_of(199))) is None


def segmenter(counts):
    """Parts with these numbers of predicted points, for any cloud."""
    labels = np.repeat(np.arange(len(counts)), counts)
    return SoftPartCount(lambda cloud: jnp.eye(len(counts))[np.resize(labels, cloud.capacity)])


@pytest.mark.parametrize(
    ("parts", "points", "stops"),
    [
        (("part 0", "part 1"), 60, True),
        (("part 0", "part 2"), 60, False),
        (("part 2",), 40, True),
        (("part 2",), 41, False),
    ],
)
def test_parts_found_counts_points_of_the_wanted_parts(parts, points, stops):
    planner = planner_of(ExpectedUtilityImprovement(segmenter((80, 80, 40))))
    reason = PartsFound(points, parts).after(after(planner, cloud_of(200, 200)))
    assert (reason is not None) == stops


@pytest.mark.parametrize(("points", "size"), [(80, 0.1), (80, 0.4)])
def test_expected_coverage_is_the_share_of_the_area_that_poses_show(points, size):
    """For a posterior of a single ball, whose area is sampled in float64."""
    grid = Grid(64)
    ball, planner = balls(grid, [0.8]), planner_of(Coverage())
    upper = np.asarray(fibonacci_sphere(points))
    upper = upper[upper[:, 1] > 0]
    cloud = PointCloud.from_arrays(0.8 * upper, upper, 256)
    # Points as near as neighbouring points are to each other count as seen too.
    apart = np.linalg.norm(0.8 * (upper[:, None] - upper), axis=-1)
    apart = max(size, np.median(np.sort(apart, axis=1)[:, 1]))
    surface = np.random.default_rng(0).normal(size=(20_000, 3))
    surface *= 0.8 / np.linalg.norm(surface, axis=1, keepdims=True)
    is_visible = np.zeros(len(surface), bool)
    for pose in DiscreteSearch(10).candidates.poses():
        origin, rotation = np.asarray(pose.position, np.float64), np.asarray(pose.rotation, np.float64)
        offset = surface - origin
        cosine = -np.sum(offset * surface, axis=1) / np.linalg.norm(offset, axis=1) / 0.8
        local = offset @ rotation
        column, row = CAMERA.to_pixels(local[:, :2] / local[:, 2:]).T
        is_visible |= (cosine >= 0.2) & (np.minimum(row, column) >= 0) & (row < CAMERA.height) & (column < CAMERA.width)
    is_near = cKDTree(cloud.to_numpy()[0]).query(surface)[0] <= apart
    share = float(np.mean(is_near[is_visible]))
    assert 0.05 < share < 0.97
    context = dataclasses.replace(after(planner, cloud, surfaces=ball), observations=Observations.start(cloud, 4))
    # From 1,024 points, some of which coincide.
    assert expected_coverage(context, NewSurface(size)) == pytest.approx(share, abs=0.03)
    assert Covered(share - 0.04, size).after(context) is not None
    assert Covered(min(share + 0.04, 1.0), size).after(context) is None
    # The size is a length in the world.
    small = dataclasses.replace(context, frame=Frame(10.0))
    assert Covered(share - 0.04, 0.1 * size).after(small) == Covered(share - 0.04, size).after(context)


FINE, EYE = Grid(64), Camera(height=50, width=50)


def looking(poses, candidates, radii):
    """The state after scans of the ball from poses, with two balls as posterior samples, from which no cell is cut."""
    planner = planner_of(NewSurface(), DiscreteSearch(candidates))
    planner = dataclasses.replace(planner, camera=EYE, sampler=dataclasses.replace(planner.sampler, grid=FINE))
    *_, observations = planner.replay((pose, scan(SCENE, EYE, pose)) for pose in poses)
    surfaces = balls(FINE, radii).without_cells(jnp.zeros((2, 63, 63, 63), bool))
    context = after(planner, observations.cloud, surfaces=surfaces)
    return dataclasses.replace(context, observations=observations)


def test_surface_that_faces_no_view_is_unseen():
    """After one view of a ball from afar less than half of it is seen. After a second view from the other side a part
    remains."""
    poses = look_at([(0.0, 0.0, 5.0), (0.0, 0.0, -5.0)])
    # A ring remains that the views see at a cosine below 0.2, where cos = (5 n_z - 0.8) / |5 - 0.8 n|.
    heights = np.linspace(-1.0, 1.0, 20_001)
    share = np.mean((5.0 * heights - 0.8) / np.sqrt(25.0 - 8.0 * heights + 0.64) >= 0.2)
    assert 0.3 < share < 0.4
    for count in (1, 2):
        context = looking(poses[:count], 24, [0.8, 0.8])
        assert expected_coverage(context, NewSurface()) == pytest.approx(count * share, abs=0.02)


def test_surface_that_views_looked_through_need_not_be_covered():
    """Two samples: the ball that was measured, and a larger ball that every view looked through."""
    poses = look_at([(0.0, 0.0, 5.0), (5.0, 0.0, 0.0)])
    # The test above has as many candidates, so that both tests share a program.
    candidates = jax.tree.map(lambda rows: jnp.repeat(rows, 12, axis=0), poses)
    context = looking(poses, candidates, [0.8, 1.1])
    planner, observations, surfaces = context.planner, context.observations, context.surfaces()
    assert expected_coverage(context, NewSurface()) < 0.45
    measurable = observations.looks.without_unmeasured(surfaces, observations.poses)
    covered = expected_coverage(dataclasses.replace(context, surfaces=lambda: measurable), NewSurface())
    # Surface of the larger ball that is steep to both views may exist, except for points within a cell of excluded
    # ones.
    drawn = np.random.default_rng(2).normal(size=(50_000, 3))
    drawn /= np.linalg.norm(drawn, axis=1, keepdims=True)
    cosines = {}
    for radius in (0.8, 1.1):
        offset = np.asarray(poses.position, np.float64)[:, None] - radius * drawn
        cosines[radius] = np.max(np.sum(offset * drawn, axis=-1) / np.linalg.norm(offset, axis=-1), axis=0)
    small, large = 0.64 * np.mean(cosines[0.8] >= 0.2), 1.21 * np.mean((cosines[1.1] >= 0.2) & (cosines[1.1] < 0.5))
    assert small / (small + large) - 0.01 < covered < small / (small + large) + 0.08
    # The rule leaves out such surface for any acquisition of the planner.
    other = dataclasses.replace(planner, acquisition=Coverage())
    assert expected_coverage(dataclasses.replace(context, planner=other), NewSurface()) == pytest.approx(covered)


EAST, TOP, WEST = (look_at(place) for place in ((2.5, 0.0, 0.0), (0.0, 2.5, 0.0), (-2.5, 0.0, 0.0)))


# The second world is in millimetres, 100 for a scene unit. Poses are in the scene, and costs and values in the world.
@pytest.mark.parametrize(
    ("frame", "unit", "problem"),
    [(Frame(), 1.0, "would cost 3.93, but 1.96 of"), (Frame(0.01, (30.0, -40.0, 50.0), "z"), 100.0, "393, but 196 of")],
    ids=["scene", "millimetres"],
)
def test_values_and_costs_are_those_of_the_world(frame, unit, problem):
    way = after(planner_of(Coverage()), cloud_of(50), (EAST, TOP), seconds=30.0, frame=frame)
    name = "scene" if unit == 1.0 else "world"
    assert f"a value of 0.3 {name} units², less than 0.5" in ValueBelow(0.5).before(way, FIRST, 0.3)
    assert ValueBelow(0.5).before(way, FIRST, 0.5) is None
    quarter = 2.5 * unit * np.pi / 2.0
    assert Budget(cost=2.01 * quarter).before(way, WEST, 1.0) is None
    assert problem in Budget(cost=1.5 * quarter).before(way, WEST, 1.0)
    if unit > 1.0:
        # A user's own cost gets poses in the world, where z is up. Here it is the height by which the camera rises.
        climb = Budget(cost=260.0, of=lambda start, end: jnp.abs(end.position[2] - start.position[2]))
        assert "would cost 250, but 10 of 260" in climb.before(way, WEST, 1.0)
    assert Budget(cost=1.0).needs_proposal
    assert not Budget(seconds=1.0).needs_proposal
    assert Budget(seconds=30.5).after(way) is None
    assert Budget(seconds=30.0).after(way) == "30 of 30 seconds are spent"


def test_the_first_rule_that_holds_ends_it():
    context = after(planner_of(Coverage()), cloud_of(50), seconds=10.0)
    rule = ValueBelow(0.5) | Budget(seconds=20.0) | Budget(seconds=5.0)
    assert rule.after(context) == "10 of 5 seconds are spent"
    assert "less than 0.5" in rule.before(context, FIRST, 0.1)
    assert rule.before(context, FIRST, 0.6) is None


def test_an_episode_ends_by_its_rule_and_goes_on_by_another(tmp_path):
    """The views are those of an episode without a rule."""
    planner = planner_of(CrossEntropy(functools.partial(of_count, enough=180)), FarthestView(10))
    whole = simulate(planner, SCENE, FIRST, 6, KEY, SensorNoise(), progress=False)
    counts = [int(view.cloud.count) for view in whole.views]
    enough = next(index + 1 for index, count in enumerate(counts) if count >= 180)
    assert 1 < enough < 5
    short = simulate(planner, SCENE, FIRST, 6, KEY, folder=tmp_path, progress=False, until=Sure(0.95, 0))
    assert len(short.views) == enough
    assert short.stop_reason.startswith("sure of class 0")
    assert len(simulate(planner, SCENE, FIRST, 6, KEY, folder=tmp_path, until=Sure(0.95, 0)).views) == enough
    longer = simulate(planner, SCENE, FIRST, 6, KEY, folder=tmp_path, progress=False, until=Budget(seconds=1e6))
    assert len(longer.views) == 6
    assert longer.stop_reason is None
    for view, expected in zip(longer.views, whole.views, strict=True):
        np.testing.assert_array_equal(view.scan.points, expected.scan.points)


def test_a_view_below_the_value_is_not_taken():
    planner = planner_of(Coverage())
    episode = simulate(planner, SCENE, FIRST, 3, KEY, progress=False)
    values = [float(view.proposal.value) for view in episode.views[1:]]
    limit = 0.5 * (values[0] + values[1])
    assert values[1] < limit < values[0]
    short = simulate(planner, SCENE, FIRST, 3, KEY, progress=False, until=ValueBelow(limit))
    assert len(short.views) == 2
    assert "less than" in short.stop_reason


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Sure(1.0), "probability is 1.0; it must lie within"),
        (lambda: Sure(num_resamplings=-1), "number of resamplings is -1"),
        (lambda: PartsFound(0), "a part is found by 0 points"),
        (lambda: Covered(1.5), "share is 1.5"),
        (lambda: Covered(size=0.0), "size is 0.0"),
        (lambda: Budget(), "has no limit: give seconds or cost"),
        (lambda: Budget(seconds=0.0), "must be positive"),
        (lambda: Sure().check(planner_of(Coverage())), "Sure is about a class, but Coverage has no classifier"),
        (lambda: PartsFound().check(planner_of(Coverage())), "PartsFound is about parts, but Coverage has no"),
        (lambda: PartsFound().check(planner_of(ExpectedUtilityImprovement(segmenter((3, 3))))), "has no names for"),
        (lambda: Identified().check(planner_of(Coverage())), "Identified is about known parts, but the planner knows"),
        (lambda: (Budget(1.0) | Placed(0.1)).check(planner_of(Coverage())), "Placed is about known parts"),
    ],
)
def test_bad_input_is_named(make, message):
    with pytest.raises(InputError, match=message):
        make()
