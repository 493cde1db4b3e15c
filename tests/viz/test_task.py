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


def never(rule, index):
    return False


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


def run(score, scene, views=3):
    return small_run(nbv.RandomView(8), views, scene, score, nbv.SensorNoise(0.0, 0.0))


@pytest.fixture(scope="module")
def plain(request):
    """No pictures of surfaces, which take long and do not affect the numbers."""
    patch = pytest.MonkeyPatch()
    patch.setattr("jaxnbv.viz.shown_surface.mean_surface", lambda *arguments: None)
    yield
    patch.undo()


def page_of(episode):
    data = report_data(episode, progress=False, imagine=False)
    return data, report_html(data, "thing")


def head(text):
    """Rows at the head of the page."""
    return {name: html.unescape(value) for name, value in re.findall(r"<dt>(\w+)</dt><dd[^>]*>([^<]*)</dd>", text)}


def test_probabilities_by_view_are_those_of_the_classifier(plain):
    scene = pyramid_scene(Split.TEST, 1)
    episode = run(nbv.CrossEntropy(Leaning(), 512), nbv.SDFSurface(scene))
    _, text = page_of(episode)
    header, *rows, true = Page(text).tables["Probability"]
    assert header == list(NAMES)
    expected = []
    for view in episode.views:
        mean = np.asarray(view.cloud.to_numpy()[0], np.float64).mean(axis=0)
        odds = np.exp(6.0 * np.array([-mean[0], mean[0], mean[1]]))
        expected.append(odds / odds.sum())
    assert [row[0] for row in rows] == ["view 1", "view 2", "view 3"]
    np.testing.assert_allclose([[float(cell) for cell in row[1:]] for row in rows], expected, rtol=6e-3)
    # The scene is of class 1.
    assert int(scene.label) == 1
    assert true == ["in truth", "0", "1", "0"]
    best = int(np.argmax(expected[-1]))
    assert head(text)["Found"].startswith(f"{NAMES[best].capitalize()}, probability {expected[-1][best]:.2f}")
    assert head(text)["Found"].endswith("In truth: right")
    assert "What is it?" in text


def test_a_utility_of_ones_own_has_its_chart_and_its_truth(plain):
    """The true height of a ball is its radius."""
    episode = run(nbv.ExpectedUtilityImprovement(greatest_height), nbv.SDFSurface(Sphere(0.9)))
    _data, text = page_of(episode)
    header, *rows, true = Page(text).tables["Greatest height"]
    assert header == ["greatest height"]
    heights = [float(view.cloud.to_numpy()[0][:, 1].max()) for view in episode.views]
    assert [row[1] for row in rows] == [number_text(height) for height in heights]
    assert float(true[1]) == pytest.approx(0.9, abs=0.01)
    assert "<h1>Greatest height?" in text
    settled = abs(heights[-1] / heights[-2] - 1.0) < 0.05
    assert head(text)["Sure"].startswith("From view" if settled else "Not yet after 3 views")


def test_coverage_by_view_is_the_share_of_the_truth_that_was_seen(plain):
    episode = run(nbv.Coverage(), nbv.SDFSurface(Sphere(0.9)))
    truth = 0.9 * np.asarray(nbv.geometry.fibonacci_sphere(500), np.float64)
    data = report_data(episode, truth, progress=False, imagine=False)
    _, *rows = Page(report_html(data, "ball")).tables["Surface seen (%)"]
    assert [row[1] for row in rows] == [
        number_text(100.0 * share) for share in nbv.scanning.metrics.coverage(episode.views, truth)
    ]


def test_truth_of_a_scene_is_all_over_it():
    cloud = true_cloud(nbv.SDFSurface(Sphere(0.9)), 8192)
    points, normals = cloud.to_numpy()
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 0.9, atol=0.01)
    assert np.sum(points * normals, axis=1).min() > 0.85
    assert np.abs(points.mean(axis=0)).max() < 5 * 0.9 / np.sqrt(3 * len(points))
    assert (
        true_cloud(
            nbv.scanning.GridSurface.from_values(jnp.ones((24, 24, 24)).at[12, 12, 12].set(-1.0), 0.0, nbv.Grid(24)),
            8192,
        )
        is None
    )


def test_a_class_is_not_known_of_a_scene_without_one():
    ball, cloud = nbv.SDFSurface(Sphere(0.9)), nbv.PointCloud.from_arrays([[0.0, 0.9, 0.0]], [[0.0, 1.0, 0.0]])
    for score in (nbv.CrossEntropy(Leaning()), nbv.tasks.EntropyReduction(Leaning())):
        assert score.true_answer(ball, cloud) is None
        true_answer = score.true_answer(nbv.SDFSurface(pyramid_scene(Split.TEST, 2)), cloud)
        np.testing.assert_array_equal(true_answer.values, [0.0, 0.0, 1.0])
        # The classifier knows three classes. The fourth is none of them.
        assert score.true_answer(nbv.SDFSurface(pyramid_scene(Split.TEST, 3)), cloud) is None


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
    answer = PartAnswer(("a", "b", "c", "d"), np.array([70.0, 59.0, 60.0, 500.0]), parts=(0, 1, 2))
    truth = PartAnswer(("a", "b", "c", "d"), np.array([4.0, 9.0, 0.0, 0.0]), parts=(0, 1, 2), target=1.0)
    count, points = words_of(answer).charts([truth, answer], truth)
    np.testing.assert_array_equal(count.values, [[0.0], [2.0]])
    assert count.true == [2.0]
    np.testing.assert_array_equal(points.values, [[4.0, 9.0, 0.0], [70.0, 59.0, 60.0]])
    assert words_of(answer).found == "a, c"
    # Any part with points on the whole surface belongs to the object.
    assert words_of(truth).found == "a, b"
    assert words_of(answer).settled([truth, answer], never) == [False, False]
    last = PartAnswer(("a",), np.array([60.0]), parts=(0,))
    assert words_of(last).settled([last], never) == [True]


def classes(*rows):
    return [ClassAnswer(("a", "b"), np.array([p, 1.0 - p])) for p in rows]


def settled(answers):
    """By a rule that uses only the probability."""
    return words_of(answers[-1]).settled(
        answers, lambda rule, index: bool(answers[index].values.max() >= rule.probability)
    )


@pytest.mark.parametrize(
    ("answers", "view"),
    [
        (classes(0.5, 0.96, 0.97), 2),
        (classes(0.96, 0.9, 0.97), 3),
        (classes(0.96, 0.97), 1),
        (classes(0.96, 0.94), None),
        # Sure of one class, then of the other. The second is reliable only once it is repeated.
        (classes(0.96, 0.03), None),
        (classes(0.96, 0.03, 0.02), 3),
        ([Answer(("x",), np.array([value])) for value in (1.0, 2.0, 2.05, 2.06)], 3),
        ([Answer(("x",), np.array([value])) for value in (1.0, 2.0)], None),
        ([Answer(("x",), np.array([1.0]))], None),
    ],
)
def test_since_when_an_answer_can_be_relied_on(answers, view):
    assert first_reliable(settled(answers)) == view


@pytest.mark.parametrize(
    ("answers", "view"), [(classes(0.5, 0.96, 0.97), None), (classes(0.96, 0.9, 0.97), 1), (classes(0.5, 0.6), None)]
)
def test_an_answer_that_was_lost_again_is_told(answers, view):
    assert first_lost(settled(answers)) == view


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


def test_a_rival_is_told_of_and_drawn(plain):
    scene, score = nbv.SDFSurface(pyramid_scene(Split.TEST, 1)), nbv.CrossEntropy(Leaning(), 512)
    episode = run(score, scene, views=2)
    other = small_run(nbv.FarthestView(8), 3, scene, score, nbv.SensorNoise(0.0, 0.0))
    data = report_data(episode, progress=False, imagine=False, rival=other)
    rival = data.task.rival
    p = np.exp(np.asarray(Leaning()(other.cloud), np.float64))
    text = f"{NAMES[int(np.argmax(p))]}, probability {p.max():.2f}"
    assert rival.sentence == f"Farthest view took 3 views from the same start ({text})."
    ended = dataclasses.replace(episode, stop_reason="sure of it")
    assert rival_text(other, ended) == f"Farthest view was not done after 3 views from the same start ({text})."
    assert rival_text(dataclasses.replace(other, stop_reason="sure of it"), ended).startswith(
        "Farthest view needed 3 views"
    )
    assert report_data(ended, progress=False, imagine=False).task.reliability_text.endswith(
        "It ended by its rule: sure of it."
    )
    np.testing.assert_allclose(rival.charts[0].values[2], p, atol=1e-6)
    truth = nbv.scanning.metrics.truth_points(scene, jax.random.key(0))
    np.testing.assert_allclose(
        rival.coverage_chart.values[:, 0], 100.0 * np.array(nbv.scanning.metrics.coverage(other.views, truth))
    )
    assert rival.sentence in report_html(data, "thing")
    ((_, figure),) = task_charts(data)
    (axes,) = figure.axes
    drawn = [line.get_ydata() for line in axes.lines]
    assert any(len(values) == 3 and np.allclose(values, rival.charts[0].values[:, 1]) for values in drawn)
    assert axes.get_xlim() == (0.5, 3.5)


def test_a_rival_is_asked_what_the_episode_is_asked(plain):
    """Even if it would give another answer itself. Without an answer the number of its views is given."""
    scene, score = nbv.SDFSurface(pyramid_scene(Split.TEST, 1)), nbv.CrossEntropy(Leaning(), 512)
    other = small_run(nbv.FarthestView(8), 2, scene, nbv.Coverage(), nbv.SensorNoise(0.0, 0.0))
    (chart,) = report_data(run(score, scene, 2), progress=False, imagine=False, rival=other).task.rival.charts
    assert chart.names == NAMES
    rival = report_data(other, progress=False, imagine=False, rival=run(score, scene, 1)).task.rival
    assert rival.sentence == "Random view took 1 view from the same start."
    assert rival.charts[0].label == "surface seen (%)"


def test_the_page_opens_with_the_answer_and_folds_the_settings_away(plain):
    episode = run(nbv.ExpectedUtilityImprovement(greatest_height), nbv.SDFSurface(Sphere(0.9)), views=2)
    _, text = page_of(episode)
    body = text[text.index("<body>") :]
    title, slider = body.index("<h1>"), body.index('id="slider"')
    folded = body.index("<summary>Settings and versions")
    assert title < body.index("<dt>Found</dt>") < body.index("<dt>Sure</dt>") < slider < folded
    for setting in ("GeometricSPSR(", "RandomView(", "equinox "):
        assert setting in body[folded:]
        assert setting not in body[:folded]


def test_the_page_can_be_read_and_used_without_a_mouse_or_eyes(plain):
    episode = run(nbv.ExpectedUtilityImprovement(greatest_height), nbv.SDFSurface(Sphere(0.9)), views=2)
    page = Page(page_of(episode)[1])
    ids = [attributes["id"] for _, attributes, _ in page.elements if "id" in attributes]
    assert len(ids) == len(set(ids))
    (slider,) = page.of("input")
    assert (slider["type"], slider["min"], slider["max"], slider["aria-label"]) == ("range", "1", "2", "View")
    (spoken,) = (element for _, element, _ in page.elements if element.get("aria-live") == "polite")
    assert spoken["id"] == slider["aria-describedby"]
    assert len(page.of("img")) >= 4
    assert all(len(attributes["alt"]) > 5 for attributes in page.of("img"))
    assert {"Previous view", "Next view"} <= {attributes.get("aria-label") for attributes in page.of("button")}
