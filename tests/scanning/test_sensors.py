"""Where a camera stands so that an object fits its image."""

import dataclasses
import math

import numpy as np
import pytest

from jaxnbv.checks import InputError
from jaxnbv.scanning.sensors import HEAT_SETTING, PART_SETTING, USUAL_SETTING, fitted
from jaxnbv.search import SphereCandidates


def seen_share(setting, reach):
    """Share of points of a sphere about the origin that every candidate's image holds."""
    points = np.random.default_rng(0).normal(size=(2000, 3))
    points *= reach / np.linalg.norm(points, axis=1, keepdims=True)
    inside = np.ones(len(points), bool)
    for pose in SphereCandidates(20, setting.radius).poses():
        local = (points - np.asarray(pose.position)) @ np.asarray(pose.rotation)
        column, row = setting.camera.to_pixels(local[:, :2] / local[:, 2:]).T
        inside &= (column >= 0) & (column <= setting.camera.width) & (row >= 0) & (row <= setting.camera.height)
        inside &= local[:, 2] > 0
    return inside.mean()


@pytest.mark.parametrize("asked", [{}, {"fov": 1.2}, {"fov": 0.2}, {"radius": 2.4}, {"radius": 9.0}])
@pytest.mark.parametrize("setting", [USUAL_SETTING, PART_SETTING, HEAT_SETTING])
def test_all_of_an_object_is_seen_from_everywhere_and_hardly_more(setting, asked):
    found = fitted(setting, 1.7, **asked)
    assert seen_share(found, 1.7) == 1.0
    assert seen_share(found, 1.7 * 1.06) < 1.0
    for name, value in asked.items():
        assert (found.camera.fov if name == "fov" else found.radius) == value
    assert (found.camera.width, found.camera.height) == (setting.camera.width, setting.camera.height)
    assert found.num_candidates == setting.num_candidates


def test_both_are_taken_as_given():
    found = fitted(USUAL_SETTING, 1.2, fov=0.1, radius=1.3)
    assert found == USUAL_SETTING._replace(camera=dataclasses.replace(USUAL_SETTING.camera, fov=0.1), radius=1.3)


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"radius": 1.2}, r"1\.2 from the centre .* reaches 1\.2 far .* more than 1\.26"),
        ({"radius": 1.2, "fov": 1.0}, r"more than 1\.2"),
        ({"fov": math.pi}, r"field of view is 3\.14"),
    ],
)
def test_cameras_within_the_object_are_refused(asked, words):
    with pytest.raises(InputError, match=words):
        fitted(USUAL_SETTING, 1.2, **asked)
