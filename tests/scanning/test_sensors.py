"""Where a camera stands so that an object fits its image."""

import math

import numpy as np
import pytest

from jaxnbv.geometry.pose import look_at
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


@pytest.mark.parametrize("setting", [USUAL_SETTING, PART_SETTING, HEAT_SETTING])
def test_all_of_an_object_is_seen_from_everywhere_and_hardly_more(setting):
    found = fitted(setting, 1.7)
    assert seen_share(found, 1.7) == 1.0
    assert seen_share(found, 1.7 * 1.06) < 1.0
    assert found._replace(radius=setting.radius) == setting


def test_from_further_away_the_same_ball_stands_under_the_angle_of_the_sine():
    """A ray along the silhouette touches the ball: its angle with the axis is arcsin(reach / radius)."""
    found = fitted(USUAL_SETTING, 1.0)
    edge = look_at((0.0, 0.0, found.radius))
    a = 0.5 * found.camera.fov
    direction = np.asarray(edge.rotation) @ [math.sin(a), 0.0, math.cos(a)]
    away = np.linalg.norm(np.cross(direction, np.asarray(edge.position)))
    assert away == pytest.approx(1.05, rel=1e-5)
