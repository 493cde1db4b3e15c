"""Surface that views looked at without measuring it, on a ball with a dark cap."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import jaxnbv as nbv
from jaxnbv.geometry.frame import Frame
from jaxnbv.scanning import Carving
from jaxnbv.viz.unmeasured import unmeasured, unmeasured_text

RADIUS, DARK, GRID, CAMERA = 0.6, 0.4, nbv.Grid(61, 1.2), nbv.Camera(0.6, 60, 60)
PLACES = [(0.0, 0.3, 2.4), (0.3, -0.2, 2.4)]
MESH = trimesh.creation.icosphere(5, RADIUS)
BALL = nbv.TriangleMesh(MESH.vertices, MESH.faces, Frame())


def observed(places, dark=DARK):
    """Observations of the ball by cameras at some places. No ray returned from above `dark` along z."""
    pole = nbv.PointCloud.from_arrays([[0.0, 0.0, -RADIUS]], [[0.0, 0.0, -1.0]], 8)
    observations = nbv.Observations.start(pole, 4, GRID, camera=CAMERA)
    for place in places:
        pose = nbv.look_at(place)
        scan = nbv.scan(BALL, CAMERA, pose)
        mask = scan.mask & (scan.points[:, 2] <= dark)
        sight = jnp.where(mask, jnp.linalg.norm(scan.points - pose.position, axis=-1), jnp.inf)
        scan = dataclasses.replace(scan, mask=mask, sight=sight)
        observations = observations.add_view(pose, scan, CAMERA, None, None)
    return observations


def test_a_cap_that_two_views_did_not_measure_is_one_patch():
    """Its area is 2 pi R h, and its middle is at half its height, by Archimedes. The border is accurate to about a
    cell."""
    (patch,) = unmeasured(MESH, observed(PLACES), None)
    rim = 2.0 * np.pi * np.sqrt(RADIUS**2 - DARK**2) * GRID.spacing
    assert patch.area == pytest.approx(2.0 * np.pi * RADIUS * (RADIUS - DARK), abs=rim)
    np.testing.assert_allclose(patch.middle, [0.0, 0.0, 0.5 * (RADIUS + DARK)], atol=GRID.spacing)
    assert patch.looks == 2
    words = unmeasured_text([patch], Frame())
    assert "(2 looks)" in words
    assert f"about ({patch.middle[0]:.2f}".replace("-", "−") in words


def test_one_look_is_not_enough_and_what_was_measured_or_cut_is_none():
    assert unmeasured(MESH, observed(PLACES[:1]), None) == []
    assert unmeasured(MESH, observed(PLACES, dark=np.inf), None) == []
    below = Carving(nbv.Box((-1.0, -1.0, -1.0), (1.0, 1.0, DARK)))
    assert unmeasured(MESH, observed(PLACES), below) == []
