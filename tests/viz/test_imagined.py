"""Pictures of imagined surfaces show the samples by which the view was chosen."""

import jax
import numpy as np
import pytest
from small_run import SphereModel, small_run

import jaxnbv as nbv
from jaxnbv.scanning.sdf import Sphere
from jaxnbv.viz.data import report_data
from jaxnbv.viz.imagined import image_tiles, shaded_image

CAMERA, TRUE = nbv.Camera(1.0, 32, 32), nbv.SDFSurface(Sphere(1.0))


@pytest.fixture(scope="module")
def episode():
    sampler = {"model": SphereModel(), "grid": nbv.Grid(64), "num_samples": 5, "carving": None}
    first, none = nbv.look_at((0.0, 0.0, 2.5)), nbv.SensorNoise(0.0, 0.0)
    return small_run(nbv.DiscreteSearch(8), 2, TRUE, noise=none, first=first, camera=CAMERA, **sampler)


def rim(radius):
    """Number of 96 x 96 pixels that see a ball about the origin from a distance of 2.5."""
    tangent = radius / np.sqrt(2.5**2 - radius**2)
    return np.pi * (48 * tangent / np.tan(CAMERA.fov / 2)) ** 2


def test_the_samples_are_those_of_the_step(episode):
    """Their radii follow from the key of view 2, as `simulate` derives it."""
    key = jax.random.split(jax.random.split(jax.random.fold_in(episode.key, 1))[0])[0]
    radii = 0.9 + 0.03 * np.asarray(jax.random.normal(key, (5,)), np.float64)
    first, second = report_data(episode, progress=False).views
    assert first.imagined is None
    num_pixels = [np.sum(sample.mask) for sample in second.imagined.samples]
    np.testing.assert_allclose(num_pixels, rim(radii[:4]), rtol=0.02)
    tiles = [tile.name for tile in image_tiles(second.imagined, second.image)]
    assert tiles == [*(f"imagined {k}" for k in range(1, 5)), "then seen"]
    assert second.image.mask.shape == (32, 32)
    np.testing.assert_allclose(9 * second.image.mask.sum(), rim(1.0), rtol=0.05)


def test_what_was_seen_before_is_told_from_what_was_not(episode):
    """Half of a ball was seen from +z. From +x the half towards +z is known, and the other is not."""
    cloud = np.asarray(nbv.geometry.fibonacci_sphere(4000), np.float64)
    pose = nbv.look_at((2.5, 0.0, 0.0))
    scan = nbv.scan(TRUE, CAMERA, pose)
    image = shaded_image(scan, CAMERA, pose, cloud[cloud[:, 2] > 0])
    z = np.asarray(scan.points)[:, 2].reshape(32, 32)
    assert image.is_seen[image.mask & (z > 0.0)].all()
    assert not image.is_seen[~image.mask | (z < -0.25)].any()
    assert not shaded_image(scan, CAMERA, pose, cloud[:0]).is_seen.any()
    assert 0.0 <= image.brightness.min() <= image.brightness.max() <= 1.0
