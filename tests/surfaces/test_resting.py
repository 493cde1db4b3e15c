"""Parts on a table: the sides on which they can lie."""

import numpy as np
import pytest

import jaxnbv as nbv
from jaxnbv.scanning.sdf import Cuboid, Translated, Union
from jaxnbv.surfaces import Resting


def heights(solid_sides, rotations):
    """Height of a box in each rotation: the sum of its sides along the vertical."""
    return np.abs(np.asarray(rotations))[:, 1] @ (2.0 * np.asarray(solid_sides))


def test_a_brick_lies_on_its_six_sides():
    """Its height is one of its sides. It most likely lies on the widest side."""
    sides = np.array([1.0, 0.6, 0.3])
    bank = nbv.ShapeBank.of([Cuboid(sides), Cuboid(sides[::-1].copy())], is_true_size=True)
    poses = Resting.of(bank)
    assert poses.stable.shape == (2, 6, 3, 3)
    for row, own in zip(np.asarray(poses.stable), (sides, sides[::-1]), strict=True):
        assert sorted(heights(own, row)) == pytest.approx([0.6, 0.6, 1.2, 1.2, 2.0, 2.0], abs=1e-4)
        assert heights(own, row[:1])[0] == pytest.approx(0.6, abs=1e-4)
        assert np.linalg.det(row) == pytest.approx(np.ones(6))


def test_turns_are_about_the_vertical():
    """All starts of a part keep the upward direction of a stable pose, with even rotations about it."""
    bank = nbv.ShapeBank.of([Cuboid(np.array([1.0, 0.6, 0.3]))], is_true_size=True)
    poses = Resting.of(bank)
    starts = np.asarray(poses.rotations_of(1, 60)[0])
    assert len(starts) == 60
    upward = np.unique(starts[:, 1].round(4) + 0.0, axis=0)
    assert len(upward) == 6
    assert np.array_equal(poses.rotations(60), starts)


def test_an_unstable_pose_is_not_used():
    """A tall post on a corner of a thin plate does not stand on the post's end."""
    tower = Union(
        Cuboid(np.array([1.0, 0.1, 1.0])), Translated(Cuboid(np.array([0.08, 0.9, 0.08])), np.array([0.9, 1.0, 0.9]))
    )
    bank = nbv.ShapeBank.of([tower], is_true_size=True)
    stable = np.asarray(Resting.of(bank).stable)[0]
    # Upside down, the upward axis is the part's own -y.
    assert stable[:, 1, 1].min() > -0.9
    assert stable[0, 1, 1] == pytest.approx(1.0, abs=1e-3)


def test_an_empty_bank_is_refused():
    with pytest.raises(nbv.InputError, match="the bank is empty"):
        Resting.of(nbv.ShapeBank.of([]))
