"""Representations in notebooks."""

import base64
import importlib
import io
import math
import re
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from IPython.core.formatters import HTMLFormatter
from matplotlib.figure import Figure
from PIL import Image
from small_run import CAMERA, small_planner, small_run

import jaxnbv as nbv
from jaxnbv.scanning.sdf import Sphere
from jaxnbv.viz import sphere
from jaxnbv.viz.notebook import drawing_of, html_of

SCENE, FIRST = nbv.SDFSurface(Sphere(1.0)), nbv.look_at((0.0, 0.0, 2.5))


@pytest.fixture(scope="module")
def episode():
    """An episode of a ball of radius 1, seen from two sides."""
    return small_run(nbv.DiscreteSearch(8), 2, SCENE, noise=nbv.SensorNoise(0.0, 0.0), first=FIRST)


@pytest.fixture(scope="module")
def posterior(episode):
    return episode.planner.sampler.model.condition(episode.cloud)


def parts(value):
    """The size of the picture, and the caption."""
    text = html_of(value)
    image = Image.open(io.BytesIO(base64.b64decode(re.search('base64,([^"]+)"', text).group(1))))
    return image.size, re.search("<figcaption>(.*)</figcaption>", text).group(1)


def drawn(value):
    axes = Figure().add_axes((0, 0, 1, 1))
    drawing_of(value).draw(axes)
    return axes


def test_each_is_a_small_picture_and_a_line(episode, posterior):
    count = int(episode.cloud.count)
    scan, proposal = episode.views[0].scan, episode.views[1].proposal
    facts = (
        (episode.cloud, f"{count:,} points of at most 512; box "),
        (scan, f"{int(scan.count)} points of 144 rays, {144 - int(scan.count)} met nothing; box "),
        (proposal, f"value {float(proposal.value):.4g}"),
        (episode, f"2 views by expected coverage gain, {count:,} points"),
        (posterior, "level "),
    )
    for value, expected in facts:
        size, caption = parts(value)
        assert size == (264, 264)
        assert expected in caption
        assert len(html_of(value)) < 100_000
    assert "8 candidates" in parts(proposal)[1]


def test_a_cloud_is_seen_from_where_its_normals_look(episode):
    """A half of the ball is brightest in its middle and dark at its rim. The box is as wide as the scanned part."""
    scan = episode.views[0].scan
    points = scan.to_numpy()[0]
    (dots,) = drawn(scan).collections
    away = np.linalg.norm(dots.get_offsets() - np.mean(dots.get_offsets(), axis=0), axis=1)
    brightness = dots.get_facecolors()[:, :3].mean(axis=1)
    assert brightness[away < 0.15].min() > brightness[away > 0.5].max()
    assert away.max() == pytest.approx(np.linalg.norm(points[:, :2], axis=1).max(), rel=0.1)


def test_the_slice_of_a_posterior_is_inside_the_ball(posterior):
    (image,) = drawn(posterior).images
    inside = np.asarray(image.get_array())
    assert inside.shape == (48, 48)
    axis = np.linspace(-1.5, 1.5, 48)
    row, column = 30, 11
    point = jnp.array([[axis[column], axis[row], 0.0]])
    short = (float(posterior.level) - float(posterior.mean(point)[0])) / math.sqrt(float(posterior.variance(point)[0]))
    assert inside[row, column] == pytest.approx(0.5 * (1.0 + math.erf(short / math.sqrt(2.0))), abs=1e-3)
    assert inside.min() < inside[row, column] < inside.max()


def test_a_proposal_has_its_star_and_an_episode_its_cameras(episode):
    (globe,) = drawn(episode.views[1].proposal).child_axes
    star = globe.lines[-1]
    expected = sphere.on_map(np.asarray(episode.views[1].pose.position)[None] / 2.5)[0]
    np.testing.assert_allclose(np.ravel(star.get_data()), expected, atol=1e-3)
    assert [text.get_text() for text in drawn(episode).texts] == ["1", "2"]


def test_what_has_no_picture_has_its_facts(episode):
    none = nbv.PointCloud(jnp.zeros((7, 3)), jnp.zeros((7, 3)), jnp.zeros(7, bool))
    assert html_of(none) == "<div>0 points of at most 7</div>"
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), none)
    assert html_of(batch) == "<div>a batch (3,) of clouds of up to 7 points</div>"
    with pytest.raises(nbv.InputError, match="no picture: DiscreteSearch by expected coverage gain over"):
        nbv.show(episode.planner)


def test_an_episode_is_shown_in_a_strip_and_others_large(episode, posterior, no_surfaces):
    image = Image.open(io.BytesIO(nbv.show(episode, progress=False)._repr_png_()))
    assert image.width == 480
    assert image.height > 300
    for value in (episode.cloud, episode.observations_after(2), episode.views[1].proposal, posterior):
        assert Image.open(io.BytesIO(nbv.show(value)._repr_png_())).size == (528, 528)


def test_a_session_tells_its_images_and_the_next_view():
    session = nbv.Session(CAMERA, ((-1.2,) * 3, (1.2,) * 3), small_planner(nbv.DiscreteSearch(8)), up="y")
    assert html_of(session) == "<div>no image yet</div>"
    scan = nbv.scan(SCENE, CAMERA, FIRST)
    session.add(np.asarray((scan.points - FIRST.position) @ FIRST.forward).reshape(12, 12), np.asarray(FIRST.matrix))
    assert "1 view by" in parts(session)[1]
    proposal = session.next()
    assert parts(session)[1].endswith(f"the next view is worth {proposal.value:.4g}")
    assert [text.get_text() for text in drawn(session).texts] == ["1"]


def test_ipython_is_told_how_they_are_shown(monkeypatch, episode, posterior):
    """Through IPython's own formatter, as in a notebook. A subclass has the representation of its parent."""
    formatter = HTMLFormatter()
    shell = SimpleNamespace(display_formatter=SimpleNamespace(formatters={"text/html": formatter}))
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))
    importlib.reload(nbv)
    observations, proposal = episode.observations_after(2), episode.views[1].proposal
    for value in (episode, episode.cloud, observations, proposal, posterior, episode.planner):
        assert formatter(value) == html_of(value)
    assert formatter(episode.planner.camera) is None
