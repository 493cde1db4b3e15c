"""The identity and pose of a part in words and pictures, for given hypotheses."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.text import Text
from small_run import Page, scene_in_space, small_run

import jaxnbv as nbv
from jaxnbv.geometry.rotations import rotation_about
from jaxnbv.scanning.sdf import Cuboid
from jaxnbv.surfaces.part_hypotheses import NONE, PartHypotheses
from jaxnbv.surfaces.placement import Placement
from jaxnbv.surfaces.registration import Hypotheses
from jaxnbv.tasks.identification import identity_answer
from jaxnbv.utility import Answer
from jaxnbv.viz.answers import words_of
from jaxnbv.viz.data import report_data
from jaxnbv.viz.figures import overview_figure
from jaxnbv.viz.notebook import html_of
from jaxnbv.viz.placed_shape import likeliest_part, likeliest_shape, likely_kinds, placed_parts
from jaxnbv.viz.report import report_html
from jaxnbv.viz.task import task_of

SIDES = {"cube left": (0.7, 0.7, 0.7), "slab": (0.9, 0.3, 0.5), "cube right": (0.6, 0.6, 0.6)}
BANK = nbv.ShapeBank.of([Cuboid(list(half)) for half in SIDES.values()], tuple(SIDES), is_true_size=True)
TURN = np.asarray(rotation_about(np.array([0.0, 1.0, 0.0]), 0.4))


def hypotheses(*weights):
    """Hypotheses: the slab in two places, and the left cube."""
    shapes, shifts = jnp.array([1, 1, 0]), jnp.array([[0.2, 0.1, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    places = Placement(jnp.tile(jnp.asarray(TURN), (3, 1, 1)), shifts, jnp.ones((3, 3)))
    placed = Hypotheses(shapes, places, jnp.arange(3.0), jnp.ones(3, bool))
    return PartHypotheses(BANK, placed, jnp.array(weights), *2 * [jnp.asarray(0.03)])


SLAB = hypotheses(0.5, 0.25, 0.2, 0.05)


class Told(nbv.SurfaceModel):
    """A model with these hypotheses for any observations."""

    hypotheses: PartHypotheses
    carries_hypotheses = True

    def add_state(self, observations):
        return dataclasses.replace(observations, hypotheses=self.hypotheses)

    def condition(self, observations):
        raise AssertionError("no posterior is needed")


def test_a_part_is_drawn_where_it_lies():
    first, second = placed_parts(SLAB, 4)
    assert (second.name, first.caption) == ("cube left", "slab  75 %")
    own = (first.vertices - [0.2, 0.1, 0.0]) @ TURN
    np.testing.assert_allclose(np.abs(own).max(axis=0), SIDES["slab"], atol=0.01)
    on_top = (own[:, 1] > 0.29) & (np.abs(own[:, [0, 2]]) < [0.8, 0.4]).all(axis=1)
    np.testing.assert_allclose(first.normals[on_top][:, 1], 1.0, atol=0.01)
    assert likeliest_part(hypotheses(0.3, 0.1, 0.1, 0.5)) is None
    assert likeliest_part(hypotheses(0.3, 0.2, 0.1, 0.4)).name == "slab"


def test_a_shape_of_a_bank_is_drawn_as_registered_and_the_others_as_disputed_space():
    """The slab is the likelier kind; the cube is taller, and so is the disputed space. Points lie on the slab's top."""
    bank = nbv.ShapeBank.of([Cuboid([0.7, 0.7, 0.7]), Cuboid([0.9, 0.3, 0.5])], ("cube 1", "slab 1"))
    scale, still = jnp.array([[1.0, 1.0, 1.0], [1.0, 2.0, 1.0]]), jnp.tile(jnp.eye(3), (2, 1, 1))
    placed = Hypotheses(jnp.array([0, 1]), Placement(still, jnp.zeros((2, 3)), scale), jnp.zeros(2), jnp.ones(2, bool))
    corner = [[0.5, 0.6, 0.2], [0.6, 0.6, 0.2]]
    cloud = nbv.PointCloud.from_arrays(corner, [[0.0, 1.0, 0.0]] * 2)
    weights = np.array([0.2, 0.3, 0.5])
    shape = likeliest_shape(bank, placed, likely_kinds(bank, placed, weights), cloud)
    assert (shape.name, shape.is_part) == ("slab", False)
    assert shape.probability == pytest.approx(0.3)
    np.testing.assert_allclose(np.abs(shape.vertices).max(axis=0), [0.9, 0.6, 0.5], atol=0.01)
    near = np.linalg.norm(shape.vertices - corner[0], axis=1)
    assert shape.measured[near < 0.05].min() == 1.0
    assert shape.measured[near > 0.3].max() == 0.0
    np.testing.assert_allclose(np.abs(shape.disputed_space.vertices).max(axis=0), 0.7, atol=0.05)
    assert likely_kinds(bank, placed, np.array([0.02, 0.03, 0.95])) == []
    assert likeliest_shape(bank, placed, [], cloud) is None
    # A classifier that recognises a cube changes 0.2 : 0.3 to 0.18 : 0.03, of 0.5 in all. Other classes change nothing.
    by_class = likely_kinds(bank, placed, weights, Answer(("slab", "cube"), np.array([0.1, 0.9])))
    assert by_class[0] == ("cube", pytest.approx(0.18 / 0.21), 0)
    assert likely_kinds(bank, placed, weights, Answer(("ball",), np.ones(1)))[0].name == "slab"


def test_words_name_the_likeliest_or_its_group_and_none_of_these():
    answer = identity_answer(SLAB, nbv.Identify())
    assert answer.names == (*sorted(SIDES), NONE)
    np.testing.assert_allclose(answer.values, [0.2, 0.0, 0.75, 0.05], atol=1e-6)
    before = identity_answer(hypotheses(0.1, 0.1, 0.5, 0.3), nbv.Coverage())
    words = words_of(answer)
    assert words.said(before) == "slab 75 % (was 20 %), cube left 20 % (was 50 %), none of these 5 % (was 30 %)"
    assert words.found == "slab, probability 0.75"
    sure = identity_answer(hypotheses(0.97, 0.01, 0.01, 0.01), nbv.Identify())
    assert words_of(sure).settled([before, answer, sure], lambda rule, index: True) == [False, False, True]
    (chart,) = words.charts([before, answer], None)
    assert (chart.names, chart.goal) == (answer.names, 0.95)
    grouped = identity_answer(hypotheses(0.2, 0.1, 0.6, 0.1), nbv.Identify(group=[name.split()[0] for name in SIDES]))
    assert grouped.names == ("cube", "slab", NONE)
    np.testing.assert_allclose(grouped.values, [0.6, 0.3, 0.1], atol=1e-6)


@pytest.fixture(scope="module")
def episode():
    return small_run(nbv.DiscreteSearch(8), 2, acquisition=nbv.Identify(), model=Told(SLAB))


def test_a_report_shows_the_part_over_the_scan(episode):
    data = report_data(episode, progress=False)
    assert [view.surface.caption for view in data.views] == ["slab  75 %", "slab  75 %"]
    assert data.views[1].imagined.names == ("slab", "cube left")
    assert task_of(episode).choice_text.endswith("over the likeliest parts and how they may lie.")
    page = report_html(data, "thing")
    assert Page(page).tables["Probability"][1][0] == "view 1"
    for words in ("Which part is it?", "Slab, probability 0.75", "The likeliest known shape, placed where it fits"):
        assert words in page
    assert "What the colour measures" not in page
    assert "likeliest shape" in {drawn["name"] for drawn in scene_in_space(page)[1]["data"]}
    assert "■ imagined" in {text.get_text() for text in overview_figure(data).findobj(Text)}
    assert "; slab  75 %" in html_of(episode)


def test_the_live_view_holds_the_part(episode):
    pytest.importorskip("viser", reason="viser is not installed")
    page = nbv.viz.LiveView(port=0)
    page.update(episode)
    page.stop()
    by_name = {handle.name: handle for handle in page._handles}
    assert {"/likeliest part, slab  75 %", "/other shapes"} <= set(by_name)
    assert not by_name["/imagined/2 cube left"].visible
    assert "slab 75 %" in page._text.content.lower()
    assert "likeliest part: slab" in page._legend.content
