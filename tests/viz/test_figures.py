"""Legible pictures: letters that neither collide nor are cut, and a small page."""

import dataclasses
import gzip
import itertools

import equinox as eqx
import matplotlib as mpl
import numpy as np
import pytest
import trimesh
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox
from small_run import small_run

import jaxnbv as nbv
from jaxnbv.utility import Quantity
from jaxnbv.viz import report_data
from jaxnbv.viz.answers import Chart
from jaxnbv.viz.charts import other_charts, task_charts
from jaxnbv.viz.choice import draw_choice
from jaxnbv.viz.data import ReportData
from jaxnbv.viz.figures import STYLE, overview_figure
from jaxnbv.viz.mean_surface import MeanSurface
from jaxnbv.viz.space import clustered, figures_in_space
from jaxnbv.viz.style import bar_ticks, log_ticks, middle_range
from jaxnbv.viz.task import Comparison
from jaxnbv.viz.viewpoint import viewpoint_of


@pytest.fixture(scope="module")
def episode():
    """An episode over 13 candidates. The second view stands out. The third is tied with another, which its picture
    marks."""
    return small_run(nbv.DiscreteSearch(13))


@pytest.fixture(scope="module")
def data(episode, no_surfaces):
    return report_data(episode, progress=False)


@pytest.fixture(autouse=True)
def style():
    with mpl.rc_context(STYLE):
        yield


def of_views(data, count, **changes):
    """The data of an episode with `count` views, the same ones repeated."""
    views = tuple(itertools.islice(itertools.cycle(data.views), count))
    charts = tuple(chart._replace(values=np.resize(chart.values, (count, 1))) for chart in data.task.charts)
    task = data.task._replace(charts=charts, coverage_chart=charts[0])
    return dataclasses.replace(data, views=views, task=task, **changes)


def check_letters(figure):
    """Check all texts without the numbers of cameras and the ticks beyond an axis, which claim to be visible."""
    hidden = {text for axes in figure.axes if axes.images and not axes.axison for text in axes.texts}
    renderer = FigureCanvasAgg(figure).get_renderer()
    figure.draw_without_rendering()
    for axis in (axis for axes in figure.axes for axis in (axes.xaxis, axes.yaxis)):
        low, high = sorted(axis.get_view_interval())
        for tick, place in zip(axis.get_major_ticks(), axis.get_majorticklocs(), strict=True):
            hidden |= set() if low - 1e-9 <= place <= high + 1e-9 else {tick.label1}
    labels, page = [], figure.bbox.padded(1.0)
    for text in set(figure.findobj(Text)) - hidden:
        is_off = text.axes is not None and not text.axes.axison and text not in text.axes.texts
        if text.get_visible() and text.get_text().strip() and not is_off:
            labels.append((text.get_text(), text.get_window_extent(renderer)))
    assert labels
    for text, box in labels:
        assert (Bbox.union([page, box]).extents == page.extents).all(), f"{text!r} is cut: {box} of {page}"
    for (one, here), (other, there) in itertools.combinations(labels, 2):
        overlap = Bbox.intersection(here, there)
        assert overlap is None or min(overlap.size) < 1, f"{one!r} and {other!r} collide: {here}, {there}"


def why(data, index):
    """The figure of why a view was chosen, as on the page."""
    figure = Figure(figsize=(5.2, 4.3))
    draw_choice(figure, data.views[index].proposal, data.quantity, nbv.Frame())
    return figure


LONG = Quantity(
    "expected improvement of the greatest height over the table at the back", "hundredths of scene units", ""
)


@pytest.mark.parametrize(("count", "changes"), [(1, {"quantity": LONG}), (2, {}), (3, {"quantity": LONG}), (7, {})])
def test_letters_neither_collide_nor_are_cut(data, count, changes, monkeypatch):
    assert not data.has_deviations
    monkeypatch.setattr(ReportData, "has_deviations", True)
    subset = of_views(data, count, **changes)
    charts = [figure for _, figure in (*task_charts(subset), *other_charts(subset))]
    for figure in (overview_figure(subset), *charts, *([why(subset, count - 1)] if count <= 3 else [])):
        check_letters(figure)


@pytest.mark.parametrize("low", [1e-4, 2e-3, 0.04])
def test_the_ticks_of_any_range_have_room(data, low, monkeypatch):
    monkeypatch.setattr(ReportData, "deviations", (low, 1.0))
    monkeypatch.setattr(ReportData, "has_deviations", True)
    check_letters(overview_figure(of_views(data, 2)))


@pytest.mark.parametrize("names", [("one",), tuple(f"a part of a name of {k}" for k in range(12))])
@pytest.mark.parametrize("marks_true_name", [True, False])
def test_legends_of_the_task_have_room(data, names, marks_true_name):
    values = np.linspace(0.0, 1.0, len(names))
    chart = Chart("a quantity (units)", names, np.tile(values, (3, 1)), values[::-1], marks_true_name, 0.9)
    rival = Comparison("farthest view", "", (chart._replace(values=np.tile(values, (7, 1))),), data.task.coverage_chart)
    ((_, figure),) = task_charts(dataclasses.replace(data, task=data.task._replace(charts=(chart,), rival=rival)))
    check_letters(figure)


def test_ranges_and_ticks_are_round():
    assert middle_range(np.linspace(0.0, 0.09, 1001)[14:]) == pytest.approx((0.002, 0.1))
    np.testing.assert_allclose(log_ticks(0.001, 0.1), [0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1])
    for low, high, ticks in (
        (0.001, 0.1, [0.001, 0.01, 0.1]),
        (0.0005, 0.05, [0.001, 0.01]),
        (0.02, 0.05, [0.02, 0.05]),
        (1e-8, 1.0, [1e-8, 1e-6, 1e-4, 1e-2, 1.0]),
    ):
        assert bar_ticks(low, high) == pytest.approx(ticks)


def ball():
    """A fine mesh of the unit sphere, known to 0.01 above and to 0.1 below."""
    mesh = trimesh.creation.icosphere(subdivisions=6)
    vertices = np.asarray(mesh.vertices)
    return MeanSurface(vertices, np.asarray(mesh.faces), vertices, np.where(vertices[:, 1] > 0, 0.01, 0.1))


def test_a_small_mesh_is_kept():
    surface = ball()
    rows, faces = clustered(surface.vertices, surface.faces, 10**6)
    np.testing.assert_array_equal(rows, np.arange(len(surface.vertices)))
    np.testing.assert_array_equal(faces, np.unique(surface.faces, axis=0))


def test_ten_views_of_fine_surfaces_make_a_small_page(data):
    """Plotly takes 2 MB, compressed, and the pictures of a view less than 0.1 MB."""
    subset = of_views(data, 10)
    views = tuple(dataclasses.replace(view, surface=ball()) for view in subset.views)
    figures = figures_in_space(dataclasses.replace(subset, views=views))
    assert sum(len(gzip.compress(figure.to_json().encode())) for figure in figures) < 5e5
    mesh = figures[9].data[0]
    # Plotly's z is the scene's y.
    vertices, faces = np.stack([mesh.y, mesh.z, mesh.x], axis=1), np.stack([mesh.i, mesh.j, mesh.k], axis=1)
    assert faces.max() < len(vertices) == len(mesh.intensity)
    corners = vertices[faces]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # The mesh covers the whole sphere, with its outside outwards.
    assert 0.5 * np.linalg.norm(areas, axis=1).sum() == pytest.approx(4.0 * np.pi, rel=0.03)
    assert np.mean(np.sum(areas * corners.mean(axis=1), axis=1) > 0) > 0.99
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 1.0, atol=0.02)
    np.testing.assert_allclose(mesh.intensity[vertices[:, 1] > 0.1], -2.0, atol=0.01)
    np.testing.assert_allclose(mesh.intensity[vertices[:, 1] < -0.1], -1.0, atol=0.01)


def test_all_cameras_stand_beside_the_object_in_one_picture(episode):
    viewpoint = viewpoint_of(episode, [ball().mesh])
    assert np.linalg.norm(viewpoint.eye) == pytest.approx(1.0)
    for view in episode.views:
        position = np.asarray(viewpoint.drawn_pose(view.pose).position, np.float64)
        distance = np.linalg.norm(position)
        assert viewpoint.radius < distance < np.linalg.norm(view.pose.position)
        assert 1.09 * distance <= viewpoint.extent
        np.testing.assert_allclose(position / distance, np.asarray(view.pose.position) / 2.5, atol=0.05)


def test_the_picture_is_drawn_from_where_what_the_chosen_views_saw_is_not_hidden(episode):
    """Points at the end of a box that is open to +x are visible only from there."""
    end = np.stack([*np.mgrid[0.0:0.1:1j, -0.4:0.4:8j, -0.4:0.4:8j]], axis=-1).reshape(-1, 3)
    scan = nbv.PointCloud.from_arrays(end, np.tile([1.0, 0.0, 0.0], (len(end), 1)))
    scanned = eqx.tree_at(lambda e: [v.scan for v in e.views], episode, [scan] * 3, is_leaf=lambda x: x is None)
    sides = trimesh.creation.box((1.0, 1.0, 1.0))
    sides.apply_translation((0.5, 0.0, 0.0))
    sides.update_faces(sides.face_normals[:, 0] < 0.5)
    assert viewpoint_of(scanned, [sides]).eye[0] > 0.8 > viewpoint_of(scanned, []).eye[0] > 0.2


def test_a_record_without_standard_errors_is_drawn_too(data):
    """Records of earlier versions have none."""
    errors = [view.view.proposal for view in data.views[1:]]
    bare = [dataclasses.replace(one, standard_errors=None, difference_errors=None) for one in errors]
    old = eqx.tree_at(lambda d: [view.view.proposal for view in d.views[1:]], data, bare)
    check_letters(overview_figure(old))
    check_letters(why(old, 2))
