"""The live view: the contents of its scene against the observations, and its single HTML file."""

import re
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small_run import small_run
from small_session import FIRST, session_of, shot

import jaxnbv as nbv
from jaxnbv.checks import InputError
from jaxnbv.cli import view as command
from jaxnbv.viz.live import LiveView

viser = pytest.importorskip("viser", reason="viser is not installed")


@pytest.fixture(scope="module")
def watched(tmp_path_factory):
    """A session of two images and a proposal, and the page that shows it."""
    folder = tmp_path_factory.mktemp("live") / "session"
    session = session_of(folder)
    session.add(shot(FIRST), FIRST, depth_scale=1e-3)
    matrix = session.next().matrix
    page = LiveView(port=0)
    session.add(shot(matrix), matrix, depth_scale=1e-3)
    session.next()
    page.update(session)
    yield folder, session, page
    page.stop()


def handles(page):
    return {handle.name: handle for handle in page._handles}


def test_all_that_is_known_is_in_the_scene(watched):
    _, _, page = watched
    by_name = handles(page)
    expected = {"/points before", "/new points", "/surface of the mean", "/candidates", "/next view", "/imagined/1"}
    assert expected <= set(by_name)
    assert {"/cameras/view 1", "/cameras/view 2"} <= set(by_name)
    assert "/cameras/view 3" not in by_name
    assert not by_name["/imagined/1"].visible
    assert by_name["/surface of the mean"].visible


def test_cameras_stand_and_look_as_they_do(watched):
    _, session, page = watched
    for number, view in enumerate(session.episode.views, start=1):
        handle = handles(page)[f"/cameras/view {number}"]
        np.testing.assert_allclose(handle.position, view.pose.position, atol=1e-5)
        turned = Rotation.from_quat(handle.wxyz, scalar_first=True).as_matrix()
        np.testing.assert_allclose(turned, view.pose.rotation, atol=1e-5)
        assert handle.aspect == pytest.approx((64 / 90.0) / (48 / 95.0), rel=0.05)
    following = handles(page)["/next view"]
    np.testing.assert_allclose(following.position, session.next().proposal.pose.position, atol=1e-5)


def test_points_are_those_of_the_last_scan_and_those_before(watched):
    _, session, page = watched
    new, _ = session.episode.views[-1].scan.to_numpy()
    before, _ = session.episode.views[0].cloud.to_numpy()
    np.testing.assert_allclose(handles(page)["/new points"].points, new, atol=2e-3)
    np.testing.assert_allclose(handles(page)["/points before"].points, before, atol=2e-3)


def test_it_says_what_is_asked_and_what_the_colours_mean(watched):
    _, session, page = watched
    assert "2 views" in page._text.content
    assert "expected coverage gain" in page._text.content
    assert page._image is not None
    values = session.frame.length_to_world(np.asarray(session.next().proposal.values), 2)
    for words in ("next view", "the surface is known to, in world units", f"{values[np.isfinite(values)].max():.3g}"):
        assert words in page._legend.content


def test_the_slider_goes_back_to_an_earlier_view(watched):
    _, session, page = watched
    first, _ = session.episode.views[0].scan.to_numpy()
    page._slider.value = 1
    by_name = handles(page)
    np.testing.assert_allclose(by_name["/new points"].points, first, atol=2e-3)
    assert "/cameras/view 2" not in by_name
    np.testing.assert_allclose(
        by_name["/next view"].position, session.episode.views[1].proposal.pose.position, atol=1e-5
    )
    assert re.search(r"^\*\*1 view\*\*, [\d.]+ world units² of surface seen$", page._text.content, re.MULTILINE)
    page._slider.value = 2
    assert "/cameras/view 2" in handles(page)


def test_one_file_holds_the_scene(watched, tmp_path):
    _, _, page = watched
    path = page.save(tmp_path / "scene.html")
    for words in ("<p>2 views, ", "the surface is known to"):
        assert words in path.read_text()
    text = path.read_text()
    assert "<html" in text
    assert not re.findall(r'<(?:script|link|img)[^>]*(?:src|href)="https?:', text)


def test_the_command_shows_a_run(tmp_path, monkeypatch, capsys):
    """The page has its own tests above. Surfaces of the usual size take long."""
    calls = []

    class Page:
        def __init__(self, port):
            calls.append(port)

        def update(self, episode):
            calls.append(len(episode.views))

        def save(self, path):
            return path

        def stop(self):
            calls.append("stopped")

    monkeypatch.setattr("jaxnbv.viz.LiveView", Page)
    small_run(nbv.RandomView(8), views=2).save(tmp_path)
    command.view(folder=tmp_path, html=tmp_path / "scene.html", port=7)
    assert calls == [7, 2, "stopped"]
    assert "scene.html" in capsys.readouterr().out


def test_without_viser_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match=r'pip install "\.\[view\]"'):
        LiveView(0)
