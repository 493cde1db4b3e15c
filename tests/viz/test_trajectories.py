"""Gradient searches in pictures: trajectories beside candidates, a map from enough views, frusta in space, words."""

import json
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from small_run import CAMERA, scene_in_space, small_run

import jaxnbv as nbv
from jaxnbv.cli.actions.lines import Lines
from jaxnbv.geometry.pose import look_at
from jaxnbv.planning.episode import view_keys
from jaxnbv.search import Search, Trajectories
from jaxnbv.search.base import best_unvisited
from jaxnbv.search.candidates import sphere_candidates
from jaxnbv.search.rotations import rotation_from_6d
from jaxnbv.viz import report_data, sphere, write_figures
from jaxnbv.viz.answers import CoverageAnswer, number
from jaxnbv.viz.choice import MAP_VIEWS, Ascents, Choice, SphereMap, choice_of, step_values
from jaxnbv.viz.report import report_html
from jaxnbv.viz.trajectory_figures import frusta_steps, small_frusta
from jaxnbv.viz.words import describe_choice

COVERAGE = nbv.DiscreteSearch().quantity(nbv.Coverage())


def joined(first, second):
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), first, second)


class Walks(Search):
    """Answers as a gradient search does, but walks from each of four candidates to the far side of the first view."""

    uses_samples: ClassVar[bool] = True

    def propose(self, problem, key):
        candidates = sphere_candidates(4)
        values = problem.values(candidates)
        t = jnp.linspace(0.0, 0.7, 6)[:, None]
        away = (1.0 - t) * candidates.position[:, None] - t * problem.evidence.poses.position[0]
        poses = look_at(2.5 * away / jnp.linalg.norm(away, axis=-1, keepdims=True))
        flat = jax.tree.map(lambda rows: rows.reshape(-1, *rows.shape[2:]), poses)
        ways = Trajectories(poses, problem.values(flat).reshape(4, 6))
        found = best_unvisited(problem, *joined((candidates, values), ways.flat))
        return nbv.Proposal(found.pose, found.value, candidates, found.values[:4], ways)


@pytest.fixture(scope="module", autouse=True)
def coarse():
    """Surfaces are traced at a quarter of their pixels a side, which is most of what a picture takes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("jaxnbv.viz.figures._STILL", 160)
        yield


@pytest.fixture(scope="module")
def few():
    """On the sphere, from as many candidates as starts, which are too few for a map."""
    return small_run(Walks(), views=2)


@pytest.fixture(scope="module")
def few_data(few):
    return report_data(few, progress=False)


@pytest.fixture(scope="module")
def spatial(few):
    """Off the sphere, from two of enough candidates; of made-up values."""
    candidates, inwards = sphere_candidates(48), jnp.linspace(1.0, 0.8, 7)[:, None]
    poses = look_at(candidates.position[:2, None] * inwards)
    ways = Trajectories(poses, 3.0 + jnp.arange(14.0).reshape(2, 7))
    seen = nbv.Proposal(poses[1, 6], ways.values[1, 6], candidates, 2.0 - candidates.position[:, 2], ways)
    # Its points alone, which are no image from the made-up pose.
    scan = nbv.PointCloud(few.views[1].scan.points, few.views[1].scan.normals, few.views[1].scan.mask)
    changed = lambda e: (e.views[1].proposal, e.views[1].pose, e.views[1].scan)  # noqa: E731
    return eqx.tree_at(changed, few, (seen, seen.pose, scan))


@pytest.fixture(scope="module")
def spatial_data(spatial):
    return report_data(spatial, progress=False)


def page_data(text):
    start = text.index('{"views"')
    return json.loads(text[start : text.index("</script>", start)])


def trajectories(values) -> Trajectories:
    """Ways round the equator, one start every 90 degrees."""
    values = np.asarray(values, dtype=np.float32)
    starts, steps = values.shape
    angle = np.radians(90 * np.arange(starts)[:, None] + np.arange(steps))
    positions = 2.5 * np.stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)], axis=-1)
    return Trajectories(look_at(positions), jnp.asarray(values))


def proposal(candidate_values, way_values) -> nbv.Proposal:
    ways = trajectories(way_values)
    candidates = look_at(nbv.fibonacci_sphere(len(candidate_values), 2.5))
    values = jnp.asarray(candidate_values, dtype=jnp.float32)
    poses, looks = joined((candidates, values), ways.flat)
    best = jnp.argmax(looks)
    return nbv.Proposal(poses[best], looks[best], candidates, values, ways)


def test_a_choice_tells_candidates_from_trajectories():
    choice = choice_of(proposal([3.0, -jnp.inf, 5.0, 1.0, 4.0], [[4.0, 6.0, 7.0], [3.0, 2.0, 2.5]]))
    np.testing.assert_array_equal(choice.open_values, [5.0, 4.0, 3.0, 1.0])
    np.testing.assert_array_equal(choice.visited, [False, True, False, False, False])
    assert choice.directions.shape == (5, 3)
    np.testing.assert_array_equal(choice.map.directions, choice.directions)
    np.testing.assert_array_equal(choice.map.values, choice.values)
    assert (choice.rank, choice.value) == (1, 7.0)
    np.testing.assert_array_equal(choice.ascents.values, [[4.0, 6.0, 7.0], [3.0, 2.0, 2.5]])
    np.testing.assert_allclose(choice.ascents.directions[1, 0], [1.0, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(choice.chosen, choice.ascents.directions[0, 2], atol=1e-6)
    assert not choice.ascents.is_spatial
    turned = rotation_from_6d(jnp.array([1.0, 0.0, 0.02, 0.0, 1.0, 0.0]))
    for moved in (nbv.Pose(turned, np.array([0.0, 0.0, -2.5])), look_at((0.0, 0.0, -2.4))):
        # A camera looks past the origin, or has left the sphere.
        poses = jax.tree.map(lambda rows, row: rows.at[0, 0].set(row), trajectories([[1.0, 2.0]]).poses, moved)
        far = nbv.Proposal(poses[0, 0], jnp.ones(()), poses[0], jnp.ones(2), Trajectories(poses, jnp.ones((1, 2))))
        assert choice_of(far).ascents.is_spatial


def test_a_search_of_enough_candidates_makes_its_own_map(spatial, spatial_data):
    choice = spatial_data.views[1].choice
    seen = spatial.views[1].proposal
    np.testing.assert_allclose(choice.map.values, seen.values, rtol=1e-6)
    np.testing.assert_allclose(choice.map.directions, np.asarray(seen.candidates.position) / 2.5, atol=1e-6)
    assert choice.ascents.values.shape == (2, 7)
    assert choice.ascents.is_spatial
    assert choice.value >= np.nanmax(choice.values)
    alone = choice_of(eqx.tree_at(lambda p: p.trajectories, seen, None))
    assert alone.ascents is None
    assert len(alone.values) == 48


@pytest.mark.slow
def test_a_map_of_too_few_candidates_is_made_anew_with_the_same_samples(few, few_data):
    choice = few_data.views[1].choice
    assert choice.values.shape == (4,)
    assert choice.map.values.shape == (MAP_VIEWS,)
    np.testing.assert_allclose(choice.map.directions, nbv.fibonacci_sphere(MAP_VIEWS, 1.0), atol=1e-6)
    seen, planner = few.views[1].proposal, few.planner
    evidence = planner.init(few.views[0].pose, few.views[0].scan)
    # The same samples: at the candidates and on the ways they give what the search saw ...
    poses, values = joined((seen.candidates, seen.values), seen.trajectories.flat)
    np.testing.assert_allclose(step_values(few, 1, poses), values, rtol=1e-3)
    # ... and so do those drawn here, which give the map's values at its views; samples of another step do not.
    key = jax.random.split(jax.random.split(jax.random.fold_in(few.key, 1))[0])[0]
    poses = joined(poses, sphere_candidates(MAP_VIEWS))
    score = eqx.filter_jit(nbv.expected_value)
    same, other = (
        np.asarray(score(planner.acquisition, evidence.cloud, planner.imagination.sample(evidence, k), CAMERA, poses))
        for k in (key, view_keys(few.key, 0)[0])
    )
    together = np.concatenate([values, choice.map.values])
    np.testing.assert_allclose(same, together, rtol=1e-3)
    assert np.abs(other / together - 1.0).max() > 0.01


def said_of(value, others, starts=0, num_tied=None, pose=None):
    """What is said of a second view with such a value, beside candidates with others, and ascents from some starts."""
    values, directions = np.array(others), np.zeros((len(others), 3))
    ascents = Ascents(trajectories(np.zeros((starts, 2))).poses, np.zeros((starts, 2))) if starts else None
    choice = Choice(directions, values, np.zeros(3), value, SphereMap(directions, values), ascents, num_tied)
    pose = look_at((0.0, 0.0, 2.5)) if pose is None else pose
    seen = CoverageAnswer.of_area(0.2), CoverageAnswer.of_area(0.3)
    return describe_choice(COVERAGE, choice, pose, [look_at((2.5, 0.0, 0.0))], 5, 10, seen).sentence(2)


@pytest.mark.parametrize(
    ("value", "others", "starts", "words"),
    [
        (
            4570.0,
            (4040.0, 2000.0, 1000.0),
            6,
            "4,570 scene units², was found by gradient ascent from 6 starts: 13 % above",
        ),
        (4570.0, (4040.0, 2000.0, 1000.0), 6, "the best of 3 open candidates (4,040; median 2,000)."),
        (9.0, (3.0, 2.0), 2, "from 2 starts: 3 times the best of 2 open candidates (3; median 2.5)."),
        (3.0003, (3.0, 2.0), 2, "from 2 starts: level with the best of 2 open candidates (3; median 2.5)."),
        (1.997, (1.0, 0.5), 2, "100 % above the best"),
        (1.0, (0.0, -1.0), 2, "ahead of the best of 2 open candidates (0; median −0.5)."),
        (2.0, (1.0,), 1, "by gradient ascent from 1 start: 2 times the one open candidate (1)."),
        (2.0, (), 1, "2 scene units², was found by gradient ascent from 1 start. It"),
        (
            3.0,
            (3.0, 2.0, 1.0),
            6,
            "was the highest of 3 open candidates: 1.5 times the median (2), 50 % above the runner-up (2). The "
            "gradient ascent from 6 starts found nothing better. It",
        ),
        (3.0, (3.0, 2.0, 1.0), 0, "1.5 times the median (2), 50 % above the runner-up (2). It added"),
    ],
)
def test_words_say_what_the_ascent_gained(value, others, starts, words):
    said = said_of(value, others, starts)
    assert words in said
    assert said.startswith(
        "View 2 looks from (0.00, 0.00, 2.50), 0° above the horizon, 90° from the nearest earlier view. Its"
    )


@pytest.mark.parametrize(
    ("level", "words"),
    [
        (None, "above the runner-up (2). It added"),
        (0, "above the runner-up (2). It stands out: no other is within two standard errors of it. It added"),
        (1, "cannot be told from 1 other, within two standard errors. It added"),
        (3, "cannot be told from 3 others, within two standard errors. It added"),
    ],
)
def test_words_say_whether_the_samples_tell_it_from_the_others(level, words):
    assert words in said_of(3.0, (3.0, 2.0, 1.0), num_tied=level)


def test_words_say_where_a_camera_looks_past_the_centre():
    pose = look_at((0.0, 0.0, 2.0), target=(2.0 * np.tan(np.radians(7.0)), 0.0, 0.0))
    assert "the horizon, 2.00 from the centre and aimed 7° off it, 90° from" in said_of(2.0, (1.0,), 1, pose=pose)


def test_the_sentence_and_the_summary_tell_the_numbers_of_the_step(few, few_data, capsys):
    view = few_data.views[1]
    seen = few.views[1].proposal
    best = float(np.max(seen.values))
    assert f"was found by gradient ascent from 4 starts: {100 * (float(seen.value) / best - 1):.2g} %" in view.sentence
    assert f"the best of 4 open candidates ({number(best)}; median" in view.sentence
    lines = Lines(few.planner)
    for one in few.views:
        lines(one)
    first, _, second = capsys.readouterr().out.splitlines()[:3]
    assert first == "views are chosen by expected coverage gain (scene units²)"
    assert second.endswith(f"points   {number(float(seen.value))}, by ascent from {number(best)}")


def test_frusta_stand_along_a_trajectory(spatial):
    ascents = choice_of(spatial.views[1].proposal).ascents
    np.testing.assert_array_equal(frusta_steps(ascents), [0, 2, 4, 6])
    edges = small_frusta(ascents, 1, CAMERA)
    np.testing.assert_allclose(edges[:, 0, 0], ascents.poses.position[1, ::2], atol=1e-6)
    assert np.linalg.norm(edges[:, 0, 1] - edges[:, 0, 0], axis=-1).max() < 0.2


@pytest.mark.slow
def test_pictures_of_a_search_in_space(spatial, spatial_data, tmp_path):
    paths = write_figures(spatial_data, CAMERA, tmp_path, progress=False)
    names = ["coverage.png", "overview.png", "task.png", "view_01.png", "view_02.png", "view_02_imagined.png"]
    names += ["view_02_trajectories.png"]
    assert sorted(path.name for path in paths) == sorted(path.name for path in tmp_path.iterdir()) == names
    with Image.open(tmp_path / "view_02_trajectories.png") as image:
        assert image.size == (860, 980)
        assert np.asarray(image.convert("L")).std() > 5
    text = report_html(spatial, spatial_data, "mug")
    stage, told = scene_in_space(text), page_data(text)["views"][1]
    first, second = stage["views"]
    assert first["ascents"] is None
    ways = spatial.views[1].proposal.trajectories
    np.testing.assert_allclose(second["ascents"]["positions"], ways.poses.position, atol=1e-3)
    np.testing.assert_allclose(second["ascents"]["values"], ways.values, rtol=1e-6)
    assert np.shape(second["ascents"]["frusta"]) == (2, 4, 8, 2, 3)
    assert len(told["choice"]["values"]) == 48
    assert "the direction of the position" in told["choice"]["caption"]
    assert "Small cameras stand along the gradient ascents" in text
    farthest = np.linalg.norm(ways.poses.position, axis=-1).max()
    # Cameras are drawn nearer than they stood, and so all of them are in the picture.
    assert stage["extent"] >= 1.09 * stage["pull"] * farthest
    assert all(
        stage["extent"] >= 1.09 * view["pull"] * np.linalg.norm(view["frustum"][0][0]) for view in stage["views"]
    )


def test_pictures_of_a_search_on_the_sphere(few, few_data, tmp_path):
    paths = write_figures(few_data, CAMERA, tmp_path, progress=False)
    names = ["view_01.png", "view_02.png", "view_02_imagined.png", "task.png", "coverage.png", "overview.png"]
    assert [path.name for path in paths] == names
    text = report_html(few, few_data, "mug")
    assert "Small cameras" not in text
    shown = page_data(text)["views"][1]
    assert scene_in_space(text)["views"][1]["ascents"] is None
    assert "drawn from 120 more views" in shown["choice"]["caption"]
    assert shown["choice"]["image"].startswith("data:image/webp;base64,")
    marks, ways = shown["choice"]["ascents"], few.views[1].proposal.trajectories
    for name, step in (("starts", 0), ("ends", -1)):
        places = sphere.mollweide(np.asarray(ways.poses.position[:, step], np.float64) / 2.5)
        np.testing.assert_allclose(marks[name], places, atol=1e-3)
    np.testing.assert_allclose(marks["values"], ways.values[:, [0, -1]], rtol=1e-6)
    assert len(marks["ways"]) >= 4


def test_a_path_over_the_rim_is_cut_there():
    around = np.radians(np.array([170.0, 176.0, -178.0, -172.0]))
    for latitude in np.radians([0.0, 40.0, 80.0]):
        ring = np.cos(latitude)
        way = np.stack([ring * np.sin(around), np.full(4, np.sin(latitude)), ring * np.cos(around)], axis=1)
        before, after = sphere.path(way)
        assert (before[:, 0] > 0).all()
        assert (after[:, 0] < 0).all()
        np.testing.assert_allclose(before[[0]], sphere.mollweide(way[:1]), atol=1e-9)
        np.testing.assert_allclose(after[[-1]], sphere.mollweide(way[-1:]), atol=1e-9)
        np.testing.assert_allclose(before[-1] * [-1, 1], after[0], atol=1e-4)
        assert (before[-1, 0] / sphere.WIDTH) ** 2 + (before[-1, 1] / sphere.HEIGHT) ** 2 == pytest.approx(1, abs=1e-4)
    front = np.array([[0.1, 0.0, 1.0], [-0.1, 0.0, 1.0], [-0.3, 0.5, 1.0]])
    (whole,) = sphere.path(front / np.linalg.norm(front, axis=1, keepdims=True))
    assert np.linalg.norm(np.diff(whole, axis=0), axis=1).max() < 0.1


def test_of_a_candidate_that_is_not_the_best_it_says_how_the_best_stands():
    said = said_of(2.0, (3.0, 2.0, 1.0), num_tied=1)
    assert (
        "was rank 2 of 3 open candidates: 1 times the median (2), the best 3. By the samples the best cannot be told"
        in said
    )
    assert "from 1 other, within two standard errors. It added" in said
