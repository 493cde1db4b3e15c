"""The report is self-contained and complete and agrees with the episode; the data of its pictures."""

import dataclasses
import html
import json
import re

import jax.numpy as jnp
import numpy as np
import pytest
from small_run import Page, scene_in_space, small_run

import jaxnbv as nbv
from jaxnbv.scanning.sdf import Sphere
from jaxnbv.viz import report_data, write_report
from jaxnbv.viz.answers import number_text
from jaxnbv.viz.choice import candidate_values, descending_values, marks
from jaxnbv.viz.report import report_html
from jaxnbv.viz.space import figures_in_space
from jaxnbv.viz.sphere import on_map, smooth_map
from jaxnbv.viz.task import coverage_answers


@pytest.fixture(scope="module")
def episode():
    return small_run(nbv.DiscreteSearch(8))


@pytest.fixture(scope="module")
def report(episode, tmp_path_factory):
    """A report in a folder where a killed process has left a part of a page, and the data it was made of."""
    folder, all_data = tmp_path_factory.mktemp("report"), []
    (folder / ".0123456789abcdef.partial").write_bytes(b"half a page")

    def kept_data(*arguments, **options):
        all_data.append(report_data(*arguments, **options))
        return all_data[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("jaxnbv.viz.report.report_data", kept_data)
        path = write_report(episode, folder, title="a <mug> & saucer", progress=False)
    return path, *all_data


@pytest.fixture(scope="module")
def data(report):
    return report[1]


def poses_of(text):
    """Pose matrices that a reader copies."""
    return [json.loads(html.unescape(pose)) for pose in re.findall('data-pose="([^"]*)"', text)]


def test_the_page_loads_nothing_from_elsewhere(report):
    path, _ = report
    text = path.read_text(encoding="utf-8")
    page = Page(text)
    names = ("src", "href", "srcset", "action")
    loads = [element[name] for _, element, _ in page.elements for name in names if name in element]
    assert len(loads) > 10
    assert all(load.startswith("data:") for load in loads)
    assert len(page.of("script")) == 3
    style = text[text.index("<style>") : text.index("</style>")]
    assert "@import" not in style
    assert "url(" not in style
    assert path.stat().st_size < 4e6
    assert {file.name for file in path.parent.iterdir()} == {"report.html", ".lock"}


def test_the_page_holds_every_view_and_escapes_its_title(report, episode):
    path, data = report
    text = path.read_text(encoding="utf-8")
    assert "a &lt;mug&gt; &amp; saucer" in text
    assert "<mug>" not in text
    assert not re.search(r"{{|{%", text)
    assert len(scene_in_space(text)) == len(episode.views) == 3
    for matrix, view, view_data in zip(poses_of(text), episode.views, data.views, strict=True):
        assert all(part in html.unescape(text) for part in view_data.sentences.values())
        np.testing.assert_allclose(matrix, view.pose.to_matrix(), atol=1e-5)


def test_a_legend_names_only_what_its_picture_shows(report):
    """The first view has no points before it, and no view shows a known shape."""
    text = report[0].read_text(encoding="utf-8")
    legend = text[text.index('<div id="legend">') : text.index('<button id="turn"')]
    names = [re.findall(r"</span> ([^<]+)</span>", part) for part in legend.split('class="of"')[1:]]
    later = ["points before", "new points and camera"]
    assert names == [later[1:], later, later]


def test_what_is_drawn_in_space_stands_where_it_is(episode, data):
    """Plotly's z is the scene's y. Coordinates are rounded to 1 / 256."""
    figure = figures_in_space(data)[2]
    traces = {trace.name: trace for trace in reversed(figure.data)}
    names = ["surface of the mean", "points before", "new points", "cameras", "new camera"]
    assert [name for name in names if name in traces] == names
    places = {name: np.stack([trace.y, trace.z, trace.x], axis=1) for name, trace in traces.items()}
    np.testing.assert_allclose(places["new points"], episode.views[2].scan.to_numpy()[0], atol=1 / 500)
    np.testing.assert_allclose(places["points before"], episode.views[1].cloud.to_numpy()[0], atol=1 / 500)
    np.testing.assert_allclose(
        places["new camera"][0], data.viewpoint.drawn_pose(episode.views[2].pose).position, atol=1 / 500
    )


def test_poses_are_in_the_units_of_the_objects_file(episode, data, monkeypatch):
    """The units of the file of a mesh that is larger and elsewhere. Without a file they are scene units."""
    monkeypatch.setattr("jaxnbv.viz.report._scene_picture", lambda data, index: "")
    monkeypatch.setattr("jaxnbv.viz.report._choice_picture", lambda data, index: "")
    frame = nbv.Frame(0.5, (1.0, 2.0, 3.0), "z")
    elsewhere = dataclasses.replace(data, episode=dataclasses.replace(episode, frame=frame))
    matrix = np.array(poses_of(report_html(elsewhere, "mug"))[1])
    pose = np.asarray(episode.views[1].pose.to_matrix(), np.float64)
    np.testing.assert_allclose(matrix[:3, 3], frame.rotation.T @ pose[:3, 3] / 0.5 + [1.0, 2.0, 3.0], atol=1e-5)
    np.testing.assert_allclose(matrix[:3, :3], frame.rotation.T @ pose[:3, :3], atol=1e-6)


def test_the_sentence_tells_the_numbers_of_the_step(episode, data):
    view, said = episode.views[1], data.views[1].sentences
    values = np.sort(np.asarray(view.proposal.values, np.float64))[::-1]
    values = values[np.isfinite(values)]
    before, after = (data.views[i].coverage.values[0] for i in (0, 1))
    for heading, words in (
        ("Why this view", f"the highest of {len(values)} candidates that are left"),
        ("Other candidates", f"Best other {number_text(values[1])}, median {number_text(np.median(values))}"),
        ("Other candidates", "two standard errors"),
        ("Result", f"added {int(view.scan.count):,} points"),
        ("Result", f"coverage went from {before:.0f} % to {after:.0f} %"),
    ):
        assert words in said[heading]
    numbers = [number_text(value) for value in (0.001234, 186.59, 1234.5, -2.0)]
    assert numbers == ["0.00123", "187", "1,234", "−2"]


def test_without_truth_and_surface_the_page_has_the_area_that_was_seen(episode, tmp_path, no_surfaces):
    grid = nbv.Grid(24)
    distance = np.linalg.norm(np.stack(np.meshgrid(*[grid.axis] * 3, indexing="ij")), axis=0) - 1.0
    scene = nbv.scanning.GridSurface.from_values(distance, 0.0, grid)
    lone = dataclasses.replace(episode, scene=scene, views=episode.views[:1])
    page = write_report(lone, tmp_path, progress=False).read_text(encoding="utf-8")
    assert "<h2>Surface seen (scene units²)</h2>" in page
    assert f"<td>{number_text(coverage_answers(lone, None)[0].values[0])}</td>" in page
    assert "What is known after this view" in page


def test_the_area_of_a_ball_is_that_of_the_caps_that_views_saw(episode):
    """A view of a ball of radius 1 sees the cap before its horizon, 2 pi (1 - 1 / r)."""
    camera, ball = nbv.Camera(1.0, 40, 40), nbv.SDFSurface(Sphere(1.0))

    def view(pose):
        scan = nbv.scan(ball, camera, pose)
        return nbv.View(pose, scan, scan, None, camera)

    first, second = view(nbv.look_at((0.0, 0.0, 2.5))), view(nbv.look_at((0.0, 0.0, -2.5)))
    # The same view again adds nothing. A view from the other side adds as much again.
    lone = dataclasses.replace(episode, views=(first, first, second))
    once, again, both = (answer.values[0] for answer in coverage_answers(lone, None))
    assert once == pytest.approx(2.0 * np.pi * (1.0 - 1.0 / 2.5), rel=0.15)
    assert once == pytest.approx(again)
    assert both == pytest.approx(2.0 * once, rel=0.02)


def test_excluded_candidates_have_no_value():
    poses = nbv.look_at(nbv.geometry.fibonacci_sphere(5, 2.5))
    values = jnp.array([3.0, -jnp.inf, 5.0, 1.0, 4.0])
    proposal = nbv.search.Proposal(poses[0], values[0], poses, values)
    np.testing.assert_array_equal(candidate_values(proposal), [3.0, np.nan, 5.0, 1.0, 4.0])
    np.testing.assert_array_equal(descending_values(proposal), [5.0, 4.0, 3.0, 1.0])
    assert marks(proposal) == ["× excluded"]


def test_the_map_keeps_values():
    some = np.asarray(nbv.geometry.fibonacci_sphere(100), dtype=np.float64)
    np.testing.assert_allclose(on_map(np.eye(3)), [[np.pi / 2, 0.0], [0.0, np.pi / 2], [0.0, 0.0]], atol=1e-12)
    values = some[:, 1] + some[:, 0] * some[:, 2]
    values[3] = np.nan
    longitudes, latitudes, smooth = smooth_map(some, values)
    assert smooth.shape == (len(latitudes), len(longitudes))
    longitude, latitude = on_map(some).T
    there = smooth[np.abs(latitudes - latitude[:, None]).argmin(1), np.abs(longitudes - longitude[:, None]).argmin(1)]
    has_value = ~np.isnan(values) & ~np.isnan(there)
    assert has_value.sum() > 90
    np.testing.assert_allclose(there[has_value], values[has_value], atol=0.1)
    # If all candidates are above the horizon, the map has no values below it.
    upper = smooth_map(some[some[:, 1] > 0], values[some[:, 1] > 0])[2]
    assert np.isfinite(upper[latitudes > 0.2]).all()
    assert np.isnan(upper[latitudes < -0.5]).all()
