"""What a step imagined: the same samples as it was chosen by, as its camera would see them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxnbv as nbv
from jaxnbv.scanning.sdf import Sphere
from jaxnbv.viz.data import report_data
from jaxnbv.viz.imagined import depth_error, depths, look, looks

CAMERA = nbv.Camera(height=32, width=32)
TRUE_RADIUS = 1.0


class Balls(nbv.Fields):
    radii: jax.Array

    def __call__(self, x):
        return (jnp.linalg.norm(x, axis=-1) - self.radii[:, None]).astype(x.dtype)


class BallPosterior(nbv.SurfacePosterior):
    level: jax.Array

    def sample(self, key, num_samples):
        return Balls(0.8 + 0.1 * jax.random.uniform(key, (num_samples,)))


class BallModel(nbv.SurfaceModel):
    """Imagines balls of radii that the key alone decides."""

    def condition(self, cloud):
        return BallPosterior(jnp.asarray(0.0))


@pytest.fixture(scope="module")
def episode():
    planner = nbv.Planner(
        nbv.Coverage(),
        nbv.DiscreteSearch(12),
        CAMERA,
        nbv.Imagination(BallModel(), grid=nbv.Grid(64), num_samples=5, carving=None),
        capacity=1000,
    )
    first, none = nbv.look_at((0.0, 0.0, 2.5)), nbv.SensorNoise(0.0, 0.0)
    scene = nbv.SDFSurface(Sphere(TRUE_RADIUS))
    return nbv.simulate(planner, scene, first, 2, jax.random.key(5), none, progress=False)


def before(episode, index):
    return report_data(episode, progress=False).views[index].imagined


@pytest.fixture(scope="module")
def seen(episode):
    return before(episode, 1)


def ball_depth(radius, camera, pose):
    """Depth along the axis of a camera's rays to a ball about the origin, in closed form; NaN where they miss it."""
    directions = np.asarray(camera.pixel_directions(), np.float64) @ np.asarray(pose.rotation, np.float64).T
    position, square = np.asarray(pose.position, np.float64), np.sum(directions**2, axis=1)
    along = directions @ position
    root = along**2 - square * (position @ position - radius**2)
    return np.where(root > 0, (-along - np.sqrt(np.maximum(root, 0.0))) / square, np.nan)


def radii(episode):
    """Of the samples that view 2 was chosen by: the key of its samples, as `simulate` derives it."""
    key = jax.random.split(jax.random.split(jax.random.fold_in(episode.key, 1))[0])[0]
    return 0.8 + 0.1 * np.asarray(jax.random.uniform(key, (5,)), np.float64)


def middle(image):
    return image[image.shape[0] // 2, image.shape[1] // 2]


def test_the_samples_are_those_of_the_step(episode, seen):
    assert len(seen.samples) == 4
    found = [middle(sample.depth) for sample in seen.samples]
    np.testing.assert_allclose(found, 2.5 - radii(episode)[:4], atol=2e-3)
    assert before(episode, 0) is None


def test_expected_and_seen_depth_are_those_of_balls(episode, seen):
    pose, fine = episode.views[1].pose, CAMERA.resized(96, 96)
    each = np.stack([ball_depth(radius, fine, pose) for radius in radii(episode)]).reshape(5, 96, 96)
    hits = np.isfinite(each)
    mean = np.where(hits, each, 0.0).sum(axis=0) / np.maximum(hits.sum(axis=0), 1)
    # Within the rim, where a trilinear ball and a round one are the same to a thousandth.
    inner = hits.all(axis=0) & (mean < 2.0)
    assert inner.sum() > 2000
    np.testing.assert_allclose(seen.depth[inner], mean[inner], atol=5e-3)
    assert np.isnan(seen.depth[~hits.any(axis=0)]).all()
    true = ball_depth(TRUE_RADIUS, CAMERA, pose).reshape(32, 32)
    inner = np.isfinite(true) & (true < 2.1)
    np.testing.assert_allclose(seen.seen.depth[inner], true[inner], atol=2e-3)
    assert [tile.name for tile in looks(seen)] == [*(f"imagined {k}" for k in range(1, 5)), "then seen"]
    tiles, words = depths(seen)
    assert [tile.name for tile in tiles] == ["expected depth", "depth seen"]
    assert "Median error: " in words


def test_what_was_seen_before_is_told_from_what_was_not(episode):
    """Half of a ball was seen from +z: from +x its near half in z is known, the other is not."""
    cloud = 1.0 * np.asarray(nbv.fibonacci_sphere(4000), np.float64)
    pose = nbv.look_at((2.5, 0.0, 0.0))
    scan = nbv.scan(nbv.SDFSurface(Sphere(1.0)), CAMERA, pose)
    image = look(scan, CAMERA, pose, cloud[cloud[:, 2] > 0])
    z = np.asarray(scan.points)[:, 2].reshape(32, 32)
    assert image.known[image.mask & (z > 0.0)].all()
    assert not image.known[~image.mask | (z < -0.25)].any()
    assert not look(scan, CAMERA, pose, cloud[:0]).known.any()
    assert 0.0 <= image.lit.min() <= image.lit.max() <= 1.0


def test_the_error_compares_pixel_with_pixel():
    coarse = np.arange(16.0).reshape(4, 4)
    fine = np.kron(coarse, np.ones((3, 3)))
    assert depth_error(fine + 0.25, coarse) == pytest.approx(0.25)
    half = np.where(coarse < 8, np.nan, coarse)
    assert depth_error(fine - 0.5, half) == pytest.approx(0.5)
    assert depth_error(fine, np.full((4, 4), np.nan)) is None
    assert depth_error(fine[:10], coarse) is None
