"""Gradient searches in pictures and words: trajectories next to candidates."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure
from small_run import CAMERA, small_planner, small_run

import jaxnbv as nbv
from jaxnbv.cli.lines import ViewPrinter
from jaxnbv.geometry.pose import look_at
from jaxnbv.search import Trajectories
from jaxnbv.search.candidates import sphere_candidates
from jaxnbv.viz import report_data, sphere
from jaxnbv.viz.answers import CoverageAnswer, number_text
from jaxnbv.viz.choice import draw_acquisition
from jaxnbv.viz.report import report_html
from jaxnbv.viz.words import sentences_about

COVERAGE, LOTS = (search.quantity(nbv.Coverage()) for search in (nbv.DiscreteSearch(), nbv.RandomView()))


def trajectories(values) -> Trajectories:
    """Paths around the equator, with one start every 90 degrees."""
    values = np.asarray(values, dtype=np.float32)
    starts, steps = values.shape
    angle = np.radians(90 * np.arange(starts)[:, None] + np.arange(steps))
    positions = 2.5 * np.stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)], axis=-1)
    return Trajectories(look_at(positions), jnp.asarray(values))


@pytest.fixture(scope="module")
def ascended(no_surfaces):
    """An episode whose second view seems to be found by ascents from its four candidates, and its data."""
    episode = small_run(nbv.RandomView(4), views=2)
    first, second = episode.views
    ways = trajectories(np.ones((4, 6)))
    proposal = dataclasses.replace(second.proposal, pose=ways.poses[1, 5], value=jnp.asarray(2.0), trajectories=ways)
    views = (first, dataclasses.replace(second, pose=ways.poses[1, 5], proposal=proposal))
    episode = dataclasses.replace(episode, planner=small_planner(nbv.DiscreteSearch(4)), views=views)
    return episode, report_data(episode, progress=False, imagine=False)


@pytest.mark.parametrize(("count", "lots", "has_map"), [(48, False, True), (11, False, False), (48, True, False)])
def test_a_map_is_made_of_enough_candidates_and_of_no_lots(count, lots, has_map):
    candidates = sphere_candidates(count)
    proposal = nbv.search.Proposal(candidates[0], jnp.ones(()), candidates, candidates.position[:, 0])
    axes = Figure().add_axes((0, 0, 1, 1))
    draw_acquisition(axes, proposal, nbv.Quantity("", "", "", smooth=not lots))
    (globe,) = axes.child_axes
    assert any(isinstance(drawn, QuadMesh) for drawn in globe.collections) == has_map


def said_of(value, others, starts=0, pose=None, standard_error=None, quantity=COVERAGE):
    """The text for a second view with this value, next to candidates with others, and ascents from some starts."""
    pose, first = look_at((0.0, 0.0, 2.5)) if pose is None else pose, look_at((2.5, 0.0, 0.0))
    ways = trajectories(np.zeros((starts, 2))) if starts else None
    errors = None if standard_error is None else jnp.full(len(others), standard_error)
    candidates = look_at(nbv.geometry.fibonacci_sphere(max(len(others), 1), 2.5))[: len(others)]
    looked = nbv.search.Proposal(pose, jnp.asarray(value), candidates, jnp.asarray(others), ways, errors, errors)
    scan = nbv.PointCloud.from_arrays(np.eye(3), np.eye(3))
    views = [nbv.View(first, scan, scan, None, CAMERA), nbv.View(pose, scan, scan, looked, CAMERA)]
    answers = [CoverageAnswer(("of surface seen",), np.array([area]), unit="scene units²") for area in (0.2, 0.3)]
    return " ".join(sentences_about(quantity, views, answers, nbv.Frame()).values())


@pytest.mark.parametrize(
    ("value", "others", "starts", "error", "words"),
    [
        (4570.0, (4040.0, 2000.0, 1000.0), 6, None, "4,570 scene units², was found by gradient ascent from 6 starts"),
        (2.0, (), 1, None, "was found by gradient ascent from 1 start. It"),
        (3.0, (3.0, 2.0, 1.0), 6, None, "was the highest of 3 candidates that are left. Best other 2, median 2. It"),
        (3.0, (3.0, 2.0, 1.0), 0, 0.4, "Best other 2, median 2; no others within two standard errors. It"),
        (3.0, (3.0, 2.0, 1.0), 0, 0.6, "median 2; 1 other within two standard errors. It added 3 points"),
        (2.0, (3.0, 2.0, 1.0), 0, 1.1, "was rank 2 of 3 candidates that are left. Best other 3, median 2; 2 others"),
    ],
)
def test_words_say_how_a_view_stands_among_the_others(value, others, starts, error, words):
    said = said_of(value, others, starts, standard_error=error)
    assert words in said
    where = "It looks from (0.00, 0.00, 2.50), 0° above the horizon, 90° from the nearest earlier view. Its"
    assert said.startswith(where)
    assert said.endswith("surface seen went from 0.2 scene units² to 0.3 scene units².")


def test_words_tell_no_value_of_a_lot_and_where_a_camera_looks_past_the_centre():
    assert "It was drawn at random from 2 candidates that are left. It added" in said_of(0.9, (0.9, 0.5), quantity=LOTS)
    pose = look_at((0.0, 0.0, 2.0), target=(2.0 * np.tan(np.radians(7.0)), 0.0, 0.0))
    assert "the horizon, 2.00 from the centre and aimed 7° off it, 90° from" in said_of(2.0, (1.0,), 1, pose)


def test_the_sentence_the_summary_and_the_page_tell_of_ascents(ascended, capsys):
    episode, data = ascended
    best = float(np.max(episode.views[1].proposal.values))
    said = data.views[1].sentences
    assert said["Why this view"].endswith("was found by gradient ascent from 4 starts.")
    assert said["Other candidates"].startswith(f"Best candidate {number_text(best)}, median")
    printer = ViewPrinter(episode.planner)
    for view in episode.views:
        printer(view)
    first, _, second = capsys.readouterr().out.splitlines()[:3]
    assert first == "views are chosen by expected coverage gain (scene units²)"
    assert second.endswith(f"points   2, by ascent from {number_text(best)}")
    assert "<span>○ start, ● end of an ascent</span>" in report_html(data, "mug")


def test_a_path_over_the_rim_is_cut_there():
    around = np.radians(np.array([170.0, 176.0, -178.0, -172.0]))
    for latitude in np.radians([0.0, 40.0, 80.0]):
        ring = np.cos(latitude)
        way = np.stack([ring * np.sin(around), np.full(4, np.sin(latitude)), ring * np.cos(around)], axis=1)
        line = sphere.path(way)
        (cut,) = np.flatnonzero(np.isnan(line[:, 0]))
        assert (line[:cut, 0] > 0).all()
        assert (line[cut + 1 :, 0] < 0).all()
        np.testing.assert_allclose(line[[0, -1]], sphere.on_map(way[[0, -1]]), atol=1e-9)
    front = np.array([[0.1, 0.0, 1.0], [-0.1, 0.0, 1.0], [-0.3, 0.5, 1.0]])
    whole = sphere.path(front / np.linalg.norm(front, axis=1, keepdims=True))
    assert np.linalg.norm(np.diff(whole, axis=0), axis=1).max() < 0.1
