"""The ten classes of household objects."""

import functools

import numpy as np
import pytest
from solids import check_fills_its_box, check_whole, mesh_of, thinnest

from jaxnbv.studies.scenes import HOUSEHOLD, Split, household_scene

COMPUTES = True


def household(name, turn=0):
    return household_scene(Split.VALIDATION, HOUSEHOLD.index(name) + 10 * turn)


def test_the_classes_are_those_of_modelnet10_and_take_turns():
    names = ("bathtub", "bed", "chair", "desk", "dresser", "monitor", "night stand", "sofa", "table", "toilet")
    assert names == HOUSEHOLD
    assert [int(household(name, 3).label) for name in names] == list(range(10))


@pytest.mark.parametrize("name", HOUSEHOLD)
def test_objects_are_whole_fill_their_box_and_have_no_thin_part(name):
    for turn in range(2):
        mesh = mesh_of(household(name, turn))
        check_whole(mesh)
        check_fills_its_box(mesh)
    assert min(thinnest(household(name, turn).solid) for turn in range(40)) >= 0.05


@functools.cache
def solid_and_bounds(name):
    solid = household(name, 5)
    return solid, mesh_of(solid).bounds


def level_share(name, height):
    """The share of an object's horizontal box that its section at a height is inside, and the box."""
    solid, (low, high) = solid_and_bounds(name)
    at = low[1] + height * (high[1] - low[1])
    axis = np.linspace(-1.25, 1.25, 101)
    x, z = np.meshgrid(axis, axis, indexing="ij")
    inside = np.asarray(solid(np.stack([x, np.full_like(x, at), z], axis=-1).astype(np.float32))) < 0
    return inside.mean() * 2.5**2 / np.prod((high - low)[[0, 2]]), high - low


def test_objects_stand_as_they_are_used():
    """Sections of what is hollow, stands on legs, or is flat."""
    assert level_share("bathtub", 0.8)[0] < 0.6
    assert level_share("bathtub", 0.25)[0] > 0.15
    for name in ("table", "chair"):
        assert level_share(name, 0.1)[0] < 0.25
    assert level_share("dresser", 0.6)[0] > 0.3
    assert level_share("monitor", 0.1)[0] < 0.5
    size = level_share("bed", 0.4)[1]
    assert size[1] < 0.8 * max(size)
