"""The ten classes of household objects."""

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
    mesh = mesh_of(household(name))
    check_whole(mesh)
    check_fills_its_box(mesh)
    assert min(thinnest(household(name, turn).solid) for turn in range(20)) >= 0.05
