"""The live view: the contents of its scene against the observations, and its single HTML file."""

import re
import sys
from unittest.mock import Mock

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


def test_the_scene_holds_all_that_is_known_where_it_is(watched):
    _, session, page = watched
    by_name, (first, last) = handles(page), session.episode.views
    expected = {"/points before", "/new points", "/surface of the mean", "/candidates", "/next view", "/imagined/1"}
    assert expected | {"/cameras/view 1", "/cameras/view 2"} <= set(by_name)
    assert "/cameras/view 3" not in by_name
    assert by_name["/surface of the mean"].visible > by_name["/imagined/1"].visible
    for number, view in enumerate((first, last), start=1):
        handle = by_name[f"/cameras/view {number}"]
        np.testing.assert_allclose(handle.position, view.pose.position, atol=1e-5)
        turned = Rotation.from_quat(handle.wxyz, scalar_first=True).as_matrix()
        np.testing.assert_allclose(turned, view.pose.rotation, atol=1e-5)
        assert handle.aspect == pytest.approx((64 / 90.0) / (48 / 95.0), rel=0.05)
    next_pose = session.next().proposal.pose
    np.testing.assert_allclose(by_name["/next view"].position, next_pose.position, atol=1e-5)
    np.testing.assert_allclose(by_name["/new points"].points, last.scan.to_numpy()[0], atol=2e-3)
    np.testing.assert_allclose(by_name["/points before"].points, first.cloud.to_numpy()[0], atol=2e-3)


def test_it_says_what_is_asked_and_what_the_colours_mean(watched):
    _, session, page = watched
    for words in ("2 views", "expected coverage gain"):
        assert words in page._text.content
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
    text = path.read_text()
    for words in ("<html", "<p>2 views, ", "the surface is known to"):
        assert words in text
    assert not re.findall(r'<(?:script|link|img)[^>]*(?:src|href)="https?:', text)


def test_the_command_shows_a_run(tmp_path, monkeypatch, capsys):
    """The page has its own tests above. Surfaces of the usual size take long."""
    page = Mock()
    page.save.side_effect = lambda path: path
    monkeypatch.setattr("jaxnbv.viz.LiveView", Mock(return_value=page))
    small_run(nbv.RandomView(8), views=2).save(tmp_path)
    command.view(folder=tmp_path, html=tmp_path / "scene.html", port=7)
    assert nbv.viz.LiveView.call_args.args == (7,)
    assert [name for name, *_ in page.method_calls] == ["update", "save", "stop"]
    assert len(page.update.call_args.args[0].views) == 2
    assert "scene.html" in capsys.readouterr().out


def test_without_viser_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match=r'pip install "\.\[view\]"'):
        LiveView(0)
