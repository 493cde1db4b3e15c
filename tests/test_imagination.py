"""The surfaces of a name."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnbv import (
    Box,
    Carving,
    Coverage,
    GeometricSPSR,
    InputError,
    Planner,
    RandomView,
    ScreenedSPSR,
)
from jaxnbv.imagination import Imagination, ModelName, imagination


def test_the_papers_model_has_its_published_values_and_is_not_carved():
    model, carving = imagination("paper")
    assert isinstance(model, GeometricSPSR)
    assert carving is None
    published = {"lengthscale": 0.005, "variance": 0.2, "noise": 0.01, "nu": 1.5, "truncation": 50}
    for name, value in published.items():
        assert jnp.allclose(getattr(model, name), value), name


@pytest.mark.parametrize("side", [2.5, 1.25])
def test_the_default_model_knows_the_box_and_carves_by_it(side):
    model, carving = imagination(ModelName.SCREENED, side)
    assert isinstance(model, ScreenedSPSR)
    assert carving == Carving(Box.cube(side))
    (volume,) = (source.volume for source in model.values if hasattr(source, "volume"))
    assert volume == Box.cube(side)


def test_lengths_are_in_proportion_to_the_object():
    large, small = (imagination("screened", side).model for side in (2.5, 1.25))
    assert eqx.tree_equal(large, ScreenedSPSR())
    assert jnp.allclose(small.base.lengthscale, 0.5 * large.base.lengthscale)
    assert jnp.array_equal(small.base.variance, large.base.variance)
    assert small.bounding_radius == 0.5 * large.bounding_radius
    assert small.base.truncation > large.base.truncation


def test_of_a_solid_body_nothing_follows_from_what_was_seen_empty():
    kinds = [
        [type(one).__name__ for one in imagination("screened", solid=solid).model.values] for solid in (False, True)
    ]
    assert kinds == [["OutsideBoundary", "OnSurface", "SeenEmpty"], ["OutsideBoundary", "OnSurface"]]


def test_a_volume_of_ones_own_is_that_of_both():
    model, carving = imagination("screened", volume=Box.cube(1.0))
    assert carving.volume == model.values[0].volume == Box.cube(1.0)
    assert jnp.array_equal(model.base.lengthscale, ScreenedSPSR().base.lengthscale)


def test_quick_surfaces_have_fewer_frequencies():
    for name in ModelName:
        full, quick = (imagination(name, quick=quick).model for quick in (False, True))
        truncations = [getattr(model, "base", model).truncation for model in (full, quick)]
        assert truncations[1] < truncations[0]


def test_a_planner_takes_what_it_gives():
    model, carving = imagination("paper")
    planner = Planner(Coverage(), RandomView(), imagination=Imagination(model, carving=carving))
    assert planner.imagination.carving is None


def test_another_name_is_refused():
    with pytest.raises(InputError, match=r"no model 'mine': choose from screened, paper"):
        imagination("mine")
    with pytest.raises(InputError, match=r"longest side is -1\.0"):
        imagination("screened", -1.0)


@pytest.mark.parametrize("quick", [False, True])
def test_a_lengthscale_takes_the_place_of_the_short_one(quick):
    plain, given = (imagination("screened", quick=quick, lengthscale=scale).model.base for scale in (None, 0.03))
    np.testing.assert_allclose(given.lengthscale, [0.03, plain.lengthscale[1]])
    assert float(imagination("paper", quick=quick, lengthscale=0.03).model.lengthscale) == pytest.approx(0.03)
    with pytest.raises(InputError, match=r"lengthscale is -1\.0"):
        imagination("paper", lengthscale=-1.0)
