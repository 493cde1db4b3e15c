"""The report is self-contained and complete and agrees with the episode; the data of its pictures."""

import base64
import dataclasses
import html
import json
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_run import Page, scene_in_space, small_planner, small_run

import jaxnbv as nbv
from jaxnbv.sampler import StepInputs
from jaxnbv.scanning.sdf import Sphere
from jaxnbv.viz import report_data, write_report
from jaxnbv.viz.answers import number_text
from jaxnbv.viz.choice import descending_values, marks, open_values
from jaxnbv.viz.mean_surface import mean_surface
from jaxnbv.viz.report import report_html
from jaxnbv.viz.space import figures_in_space
from jaxnbv.viz.sphere import on_map, smooth_map
from jaxnbv.viz.style import log_ticks, middle_range
from jaxnbv.viz.task import coverage_answers


@pytest.fixture(scope="module")
def episode():
    return small_run(nbv.DiscreteSearch(30))


@pytest.fixture(scope="module")
def report(episode, tmp_path_factory):
    """A report in a folder where a killed process has left a part of a page."""
    folder = tmp_path_factory.mktemp("report")
    (folder / ".0123456789abcdef.partial").write_bytes(b"half a page")
    return write_report(episode, folder, title="a <mug> & saucer", progress=False)


@pytest.fixture(scope="module")
def data(episode):
    return report_data(episode, progress=False)


def poses_of(text):
    """Pose matrices that a reader copies."""
    return [json.loads(html.unescape(pose)) for pose in re.findall('data-pose="([^"]*)"', text)]


def test_the_page_loads_nothing_from_elsewhere(report):
    text = report.read_text(encoding="utf-8")
    page = Page(text)
    loads = [
        attributes[name]
        for _, attributes, _ in page.elements
        for name in ("src", "href", "srcset", "action")
        if name in attributes
    ]
    assert len(loads) > 10
    assert all(load.startswith("data:") for load in loads)
    assert len(page.of("script")) == 3
    style = text[text.index("<style>") : text.index("</style>")]
    assert "@import" not in style
    assert "url(" not in style
    assert report.stat().st_size < 4e6
    assert {file.name for file in report.parent.iterdir()} == {"report.html", ".lock"}


def test_the_page_holds_every_view_and_escapes_its_title(report, episode, data):
    text = report.read_text(encoding="utf-8")
    assert "a &lt;mug&gt; &amp; saucer" in text
    assert "<mug>" not in text
    assert not re.search(r"{{|{%", text)
    spatial = scene_in_space(text)
    assert len(spatial) == len(episode.views) == 3
    for matrix, figure_in_space, view, view_data in zip(
        poses_of(text), spatial, episode.views, data.views, strict=True
    ):
        assert all(part in html.unescape(text) for part in view_data.sentences.values())
        np.testing.assert_allclose(matrix, view.pose.to_matrix(), atol=1e-5)
        (points,) = (trace for trace in figure_in_space["data"] if trace["name"] == "new points")
        assert points["x"]["dtype"] == "f4"
        count = len(base64.b64decode(points["x"]["bdata"])) // 4
        assert count == int(view.scan.count)


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


def test_poses_are_in_the_units_of_the_objects_file(episode, data):
    """The units of the file of a mesh that is larger and elsewhere. Without a file they are scene units."""
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
    assert f"the highest of {len(values)} open candidates" in said["What it promised"]
    assert f"Best other {number_text(values[1])}, median {number_text(np.median(values))}" in said["Beside the others"]
    assert "two standard errors" in said["Beside the others"]
    assert f"added {int(view.scan.count):,} points" in said["What came"]
    before, after = (data.views[i].coverage.values[0] for i in (0, 1))
    assert f"coverage went from {before:.0f} % to {after:.0f} %" in said["What came"]


def test_of_a_scene_without_truth_the_area_that_was_seen_is_told(tmp_path, episode):
    """The first view of a ball of radius 1 sees the cap before its horizon, 2 pi (1 - 1 / r)."""
    grid = nbv.Grid(24)
    distance = np.linalg.norm(np.stack(np.meshgrid(*[grid.axis] * 3, indexing="ij")), axis=0) - 1.0
    scene = nbv.scanning.GridSurface.from_values(distance, 0.0, grid)
    camera, pose = nbv.Camera(1.0, 40, 40), nbv.look_at((0.0, 0.0, 2.5))
    seen = nbv.scan(nbv.SDFSurface(nbv.sdf.Sphere(1.0)), camera, pose)
    lone = dataclasses.replace(episode, scene=scene, views=(nbv.View(pose, seen, seen, None, camera),))
    path = write_report(lone, tmp_path, progress=False)
    page = path.read_text(encoding="utf-8")
    assert "<h2>Surface seen (scene units²)</h2>" in page
    area = report_data(lone, progress=False, imagine=False).views[0].coverage.values[0]
    assert area == pytest.approx(2.0 * np.pi * (1.0 - 1.0 / 2.5), rel=0.15)
    assert f"<td>{number_text(area)}</td>" in page
    # The same view again adds nothing. A view from the other side adds as much again.
    behind = nbv.look_at((0.0, 0.0, -2.5))
    other = nbv.scan(nbv.SDFSurface(nbv.sdf.Sphere(1.0)), camera, behind)
    views = *lone.views, *lone.views, nbv.View(behind, other, other, None, camera)
    once, again, both = (seen.values[0] for seen in coverage_answers(dataclasses.replace(lone, views=views), None))
    assert once == pytest.approx(again) == pytest.approx(area)
    assert both == pytest.approx(2.0 * area, rel=0.02)
    truth = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    assert report_data(lone, truth, progress=False).views[0].coverage.values[0] in (0.0, 50.0, 100.0)


class NoisySphere(nbv.surfaces.Fields):
    radii: jax.Array

    def __call__(self, x):
        return (jnp.linalg.norm(x, axis=-1) - self.radii[:, None]).astype(x.dtype)


class SpherePosterior(nbv.surfaces.SurfacePosterior):
    level: jax.Array

    def sample(self, key, num_samples):
        return NoisySphere(0.9 + 0.03 * jax.random.normal(key, (num_samples,)))


class SphereModel(nbv.SurfaceModel):
    def condition(self, cloud):
        return SpherePosterior(jnp.asarray(0.0))


def surface_of(sampler, observations):
    sampler = dataclasses.replace(sampler, num_samples=64)
    return mean_surface(sampler, StepInputs(observations, sampler.posterior(observations)))


def test_any_posterior_has_a_surface_with_a_standard_deviation():
    # f = |x| - r with r ~ N(0.9, 0.03^2). The surface is a sphere, known to 0.03 everywhere, as estimated from 64
    # samples.
    planner = small_planner(nbv.RandomView(), model=SphereModel(), grid=nbv.Grid(40))
    cloud = nbv.PointCloud.from_arrays([[0.9, 0.0, 0.0]], [[1.0, 0.0, 0.0]])
    surface = surface_of(planner.sampler, planner.init(None, cloud))
    radius = np.linalg.norm(surface.vertices, axis=1)
    np.testing.assert_allclose(radius, 0.9, atol=4 * 0.03 / 8 + 0.005)
    np.testing.assert_allclose(surface.deviation, 0.03, rtol=4 / np.sqrt(2 * 64))
    np.testing.assert_allclose(np.sum(surface.normals * surface.vertices, axis=1) / radius, 1.0, atol=1e-2)


def test_the_surface_of_the_mean_is_carved():
    planner = small_planner(nbv.RandomView(), model=SphereModel(), grid=nbv.Grid(40))
    observations = planner.init(None, nbv.PointCloud.from_arrays([[0.9, 0.0, 0.0]], [[1.0, 0.0, 0.0]]))
    empty = jnp.broadcast_to((planner.sampler.grid.axis > 0.3)[:, None, None], observations.empty_nodes.shape)
    vertices = surface_of(planner.sampler, eqx.tree_at(lambda s: s.empty_nodes, observations, empty)).vertices
    assert vertices[:, 0].max() < 0.3 + planner.sampler.grid.spacing
    # The other side is unchanged.
    left = vertices[vertices[:, 0] < 0.3 - planner.sampler.grid.spacing]
    np.testing.assert_allclose(np.linalg.norm(left, axis=1).max(), 0.9, atol=0.02)


def test_a_mean_without_a_surface_is_drawn_without_one(episode, data):
    far = nbv.SurfaceSampler(SphereModel(), nbv.Grid(40, 0.2), carving=None)
    assert surface_of(far, episode.observations_after(1)) is None
    bare = eqx.tree_at(lambda d: [v.surface for v in d.views], data, [None] * 3, is_leaf=lambda x: x is None)
    assert "What is known after this view" in report_html(bare, "mug")


def test_what_was_seen_is_known_better_than_what_was_not():
    scene = nbv.SDFSurface(Sphere(0.9))
    model, camera = nbv.GeometricSPSR(truncation=16, lengthscale=0.02), nbv.Camera(height=24, width=24)
    view = small_run(nbv.RandomView(12), views=1, scene=scene, model=model, camera=camera)
    surface = surface_of(view.planner.sampler, view.observations_after(1))
    distance = np.linalg.norm(surface.vertices[:, None] - view.cloud.to_numpy()[0][None, ::4], axis=-1).min(axis=1)
    assert np.median(surface.deviation[distance < 0.1]) < 0.3 * np.median(surface.deviation[distance > 0.6])


def test_excluded_candidates_have_no_value():
    poses = nbv.look_at(nbv.geometry.fibonacci_sphere(5, 2.5))
    values = jnp.array([3.0, -jnp.inf, 5.0, 1.0, 4.0])
    proposal = nbv.search.Proposal(poses[0], values[0], poses, values)
    np.testing.assert_array_equal(open_values(proposal), [3.0, np.nan, 5.0, 1.0, 4.0])
    np.testing.assert_array_equal(descending_values(proposal), [5.0, 4.0, 3.0, 1.0])
    assert marks(proposal) == ["× visited"]


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


def test_ranges_and_ticks_are_round():
    assert middle_range(np.linspace(0.0, 0.09, 1001)[14:]) == pytest.approx((0.002, 0.1))
    np.testing.assert_allclose(log_ticks(0.001, 0.1), [0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1])
    assert [number_text(value) for value in (0.001234, 186.59, 1234.5, -2.0)] == ["0.00123", "187", "1,234", "−2"]
