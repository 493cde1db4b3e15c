"""The task by view: its numbers, the truth, and the view from which the answer is sure, in the answers and on the
page."""

import dataclasses
import html
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_run import FIRST, Page, small_planner, small_run

import jaxnbv as nbv
from jaxnbv.scanning.sdf import Sphere
from jaxnbv.studies.scenes import Split, pyramid_scene
from jaxnbv.tasks.classification import ClassAnswer, Classifier
from jaxnbv.tasks.heat import Coldest
from jaxnbv.tasks.segmentation import PartAnswer
from jaxnbv.utility import Answer
from jaxnbv.viz.answers import number_text, words_of
from jaxnbv.viz.charts import task_charts
from jaxnbv.viz.data import report_data
from jaxnbv.viz.report import report_html
from jaxnbv.viz.task import first_lost, first_reliable, rival_text, task_of, true_cloud

KEY = jax.random.key(0)
PYRAMID, BALL = pyramid_scene(Split.TEST, 1), nbv.SDFSurface(Sphere(0.9))
NAMES = ("left", "right", "up")


class Leaning(Classifier):
    """A classifier by the positions of the points."""

    @property
    def classes(self):
        return NAMES

    def __call__(self, cloud):
        mean = jnp.sum(jnp.where(cloud.mask[:, None], cloud.points, 0.0), axis=0) / jnp.maximum(cloud.count, 1)
        return jax.nn.log_softmax(6.0 * jnp.array([-mean[0], mean[0], mean[1]]))


def greatest_height(cloud):
    return jnp.max(jnp.where(cloud.mask, cloud.points[:, 1], -2.0))


pytestmark = pytest.mark.usefixtures("no_surfaces")


def run(search, score, scene):
    return small_run(search, 3, scene, score, nbv.SensorNoise(0.0, 0.0))


@pytest.fixture(scope="module")
def classified():
    return run(nbv.RandomView(8), nbv.CrossEntropy(Leaning(), 512), PYRAMID)


@pytest.fixture(scope="module")
def farthest():
    return run(nbv.FarthestView(8), nbv.CrossEntropy(Leaning(), 512), PYRAMID)


@pytest.fixture(scope="module")
def measured():
    """An episode about the height of a ball, and its page."""
    episode = run(nbv.RandomView(8), nbv.ExpectedUtilityImprovement(greatest_height), BALL)
    return episode, report_html(data_of(episode), "thing")


def first_views(episode, count):
    return dataclasses.replace(episode, views=episode.views[:count])


def data_of(episode, truth=None, rival=None):
    return report_data(episode, truth, progress=False, imagine=False, rival=rival)


def head(text):
    """Rows at the head of the page."""
    return {name: html.unescape(value) for name, value in re.findall(r"<dt>(\w+)</dt><dd[^>]*>([^<]*)</dd>", text)}


def test_probabilities_by_view_are_those_of_the_classifier(classified):
    text = report_html(data_of(classified), "thing")
    header, *rows, true = Page(text).tables["Probability"]
    assert header == list(NAMES)
    expected = []
    for view in classified.views:
        mean = np.asarray(view.cloud.to_numpy()[0], np.float64).mean(axis=0)
        odds = np.exp(6.0 * np.array([-mean[0], mean[0], mean[1]]))
        expected.append(odds / odds.sum())
    assert [row[0] for row in rows] == ["view 1", "view 2", "view 3"]
    np.testing.assert_allclose([[float(cell) for cell in row[1:]] for row in rows], expected, rtol=6e-3)
    assert int(PYRAMID.label) == 1
    assert true == ["in truth", "0", "1", "0"]
    best = int(np.argmax(expected[-1]))
    assert head(text)["Answer"].startswith(f"{NAMES[best].capitalize()}, probability {expected[-1][best]:.2f}")
    assert head(text)["Answer"].endswith("In truth: right")
    assert "What is it?" in text


def test_a_utility_of_ones_own_has_its_chart_and_its_truth(measured):
    """The true height of a ball is its radius."""
    episode, text = measured
    header, *rows, true = Page(text).tables["Greatest height"]
    assert header == ["greatest height"]
    heights = [float(view.cloud.to_numpy()[0][:, 1].max()) for view in episode.views]
    assert [row[1] for row in rows] == [number_text(height) for height in heights]
    assert float(true[1]) == pytest.approx(0.9, abs=0.01)
    settled = abs(heights[-1] / heights[-2] - 1.0) < 0.05
    assert head(text)["Sure"].startswith("From view" if settled else "Not yet after 3 views")


def test_coverage_by_view_is_the_share_of_the_truth_that_was_seen(measured):
    episode = first_views(measured[0], 2)
    episode = dataclasses.replace(episode, planner=dataclasses.replace(episode.planner, acquisition=nbv.Coverage()))
    truth = 0.9 * np.asarray(nbv.geometry.fibonacci_sphere(500), np.float64)
    _, *rows = Page(report_html(data_of(episode, truth), "ball")).tables["Surface seen (%)"]
    shares = nbv.scanning.metrics.coverage(episode.views, truth)
    assert [row[1] for row in rows] == [number_text(100.0 * share) for share in shares]


def test_truth_of_a_scene_is_all_over_it():
    points, normals = true_cloud(BALL, 8192).to_numpy()
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 0.9, atol=0.01)
    assert np.sum(points * normals, axis=1).min() > 0.85
    assert np.abs(points.mean(axis=0)).max() < 5 * 0.9 / np.sqrt(3 * len(points))
    grid = nbv.scanning.GridSurface.from_values(jnp.ones((24, 24, 24)).at[12, 12, 12].set(-1.0), 0.0, nbv.Grid(24))
    assert true_cloud(grid, 8192) is None


def test_a_class_is_not_known_of_a_scene_without_one():
    cloud = nbv.PointCloud.from_arrays([[0.0, 0.9, 0.0]], [[0.0, 1.0, 0.0]])
    third, fourth = (nbv.SDFSurface(pyramid_scene(Split.TEST, index)) for index in (2, 3))
    for score in (nbv.CrossEntropy(Leaning()), nbv.tasks.EntropyReduction(Leaning())):
        assert score.true_answer(BALL, cloud) is None
        np.testing.assert_array_equal(score.true_answer(third, cloud).values, [0.0, 0.0, 1.0])
        # The classifier knows three classes. The fourth is none of them.
        assert score.true_answer(fourth, cloud) is None


def test_heat_is_charted_by_temperature_and_distance():
    answer = Coldest(("coldest",), np.array([0.4]), point=np.array([1.0, 0.0, 2.0]))
    truth = Coldest(("coldest",), np.array([0.1]), point=np.array([1.0, 3.0, -2.0]))
    temperature, distance = words_of(answer).charts([truth, answer], truth)
    np.testing.assert_array_equal(temperature.values, [[0.1], [0.4]])
    assert temperature.true == [0.1]
    np.testing.assert_array_equal(distance.values, [[0.0], [5.0]])
    (alone,) = words_of(answer).charts([answer], None)
    assert alone.true is None


def test_parts_are_found_by_their_points():
    names = tuple("abcd")
    answer = PartAnswer(names, np.array([70.0, 59.0, 60.0, 500.0]), parts=(0, 1, 2))
    truth = PartAnswer(names, np.array([4.0, 9.0, 0.0, 0.0]), parts=(0, 1, 2), target=1.0)
    count, points = words_of(answer).charts([truth, answer], truth)
    np.testing.assert_array_equal(count.values, [[0.0], [2.0]])
    assert count.true == [2.0]
    np.testing.assert_array_equal(points.values, [[4.0, 9.0, 0.0], [70.0, 59.0, 60.0]])
    assert words_of(answer).found == "a, c"
    # Any part with points on the whole surface belongs to the object.
    assert words_of(truth).found == "a, b"
    assert words_of(answer).settled([truth, answer], lambda rule, index: False) == [False, False]
    last = PartAnswer(("a",), np.array([60.0]), parts=(0,))
    assert words_of(last).settled([last], lambda rule, index: False) == [True]


def classes(*rows):
    return [ClassAnswer(("a", "b"), np.array([p, 1.0 - p])) for p in rows]


@pytest.mark.parametrize(
    ("answers", "view", "lost"),
    [
        (classes(0.5, 0.96, 0.97), 2, None),
        (classes(0.96, 0.9, 0.97), 3, 1),
        (classes(0.96, 0.97), 1, None),
        (classes(0.5, 0.6), None, None),
        # Sure of one class, then of the other. The second is reliable only once it is repeated.
        (classes(0.96, 0.03), None, 1),
        (classes(0.96, 0.03, 0.02), 3, 1),
        ([Answer(("x",), np.array([value])) for value in (1.0, 2.0, 2.05, 2.06)], 3, None),
        ([Answer(("x",), np.array([value])) for value in (1.0, 2.0)], None, None),
        ([Answer(("x",), np.array([1.0]))], None, None),
    ],
)
def test_since_when_an_answer_can_be_relied_on_and_when_it_was_lost(answers, view, lost):
    """By a rule that uses only the probability."""
    is_reliable = words_of(answers[-1]).settled(
        answers, lambda rule, index: bool(answers[index].values.max() >= rule.probability)
    )
    assert first_reliable(is_reliable) == view
    assert first_lost(is_reliable) == lost


def test_a_class_that_halves_of_the_points_do_not_tell_is_sure_nowhere():
    """Certain of one class given all points, and of the other given some halves of them."""

    def by_count(cloud):
        return jnp.log(jnp.where(cloud.count >= 40, jnp.array([0.99, 0.01]), jnp.array([0.01, 0.99])))

    planner = small_planner(nbv.RandomView(8), nbv.CrossEntropy(by_count), capacity=50)
    episode = nbv.simulate(planner, Sphere(0.9), FIRST, 2, KEY, progress=False, until=nbv.Sure(0.95))
    assert [view.cloud.count for view in episode.views] == [50, 50]
    assert episode.stop_reason is None
    task = task_of(episode)
    assert task.answers[-1].values.max() > 0.95
    assert task.reliability_text.startswith("Not yet after 2 views")
    # Without halves to classify, the first view is enough.
    assert nbv.Sure(0.95, 0).reason(planner.acquisition, episode.cloud, KEY) is not None


def test_a_rival_is_told_of_and_drawn(classified, farthest):
    episode = first_views(classified, 2)
    data = data_of(episode, rival=farthest)
    rival, ended = data.task.rival, dataclasses.replace(episode, stop_reason="sure of it")
    p = np.exp(np.asarray(Leaning()(farthest.cloud), np.float64))
    text = f"{NAMES[int(np.argmax(p))]}, probability {p.max():.2f}"
    assert rival.sentence == f"Farthest view took 3 views from the same start ({text})."
    assert rival_text(farthest, ended) == f"Farthest view was not done after 3 views from the same start ({text})."
    ended_too = dataclasses.replace(farthest, stop_reason="sure of it")
    assert rival_text(ended_too, ended).startswith("Farthest view needed 3 views")
    assert task_of(ended).reliability_text.endswith("It stopped: sure of it.")
    np.testing.assert_allclose(rival.charts[0].values[2], p, atol=1e-6)
    truth = nbv.scanning.metrics.truth_points(nbv.SDFSurface(PYRAMID), jax.random.key(0))
    shares = np.array(nbv.scanning.metrics.coverage(farthest.views, truth))
    np.testing.assert_allclose(rival.coverage_chart.values[:, 0], 100.0 * shares)
    assert rival.sentence in report_html(data, "thing")
    ((_, figure),) = task_charts(data)
    (axes,) = figure.axes
    drawn = [line.get_ydata() for line in axes.lines]
    assert any(len(values) == 3 and np.allclose(values, rival.charts[0].values[:, 1]) for values in drawn)
    assert axes.get_xlim() == (0.5, 3.5)


def test_a_rival_is_asked_what_the_episode_is_asked(classified, farthest):
    """Even if it would give another answer itself. Without an answer the number of its views is given."""
    other = dataclasses.replace(farthest, planner=dataclasses.replace(farthest.planner, acquisition=nbv.Coverage()))
    (chart,) = task_of(classified, rival=other).rival.charts
    assert chart.names == NAMES
    rival = task_of(other, np.zeros((1, 3)), rival=first_views(classified, 1)).rival
    assert rival.sentence == "Random view took 1 view from the same start."
    assert rival.charts[0].label == "surface seen (%)"


def test_the_page_opens_with_the_answer_and_folds_the_settings_away(measured):
    body = measured[-1].partition("<body>")[2]
    titles = (
        "<h1>Greatest height?",
        "<dt>Answer</dt>",
        "<dt>Sure</dt>",
        'id="slider"',
        "<summary>Settings and versions",
    )
    assert [body.index(title) for title in titles] == sorted(body.index(title) for title in titles)
    front, _, folded = body.partition(titles[-1])
    for setting in ("GeometricSPSR(", "RandomView(", "equinox "):
        assert setting in folded
        assert setting not in front


def test_the_page_can_be_read_and_used_without_a_mouse_or_eyes(measured):
    page = Page(measured[-1])
    ids = [attributes["id"] for _, attributes, _ in page.elements if "id" in attributes]
    assert len(ids) == len(set(ids))
    (slider,) = page.of("input")
    assert (slider["type"], slider["min"], slider["max"], slider["aria-label"]) == ("range", "1", "3", "View")
    (spoken,) = (element for _, element, _ in page.elements if element.get("aria-live") == "polite")
    assert spoken["id"] == slider["aria-describedby"]
    assert len(page.of("img")) >= 4
    assert all(len(attributes["alt"]) > 5 for attributes in page.of("img"))
    assert {"Previous view", "Next view"} <= {attributes.get("aria-label") for attributes in page.of("button")}
