"""Noise of real depth cameras: its law by statistics, its steps, its units, and an episode that is scanned with it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxnbv as nbv

KEY = jax.random.key(0)
COUNT = 20_000


@pytest.mark.parametrize(
    ("noise", "at_a_metre", "step"),
    [
        (nbv.DepthNoise.kinect_v1(), 1.425e-3, 2.85e-3),
        # 0.08 pixels, and a 32nd of one, of 424 pixels x 0.05 m.
        (nbv.DepthNoise.realsense_d435(), 0.08 / 21.2, 1 / 32 / 21.2),
    ],
)
def test_noise_and_steps_grow_with_the_square_of_the_depth(noise, at_a_metre, step):
    for depth in (0.7, 2.0, 4.0):
        found = np.asarray(noise.measured(jnp.full(COUNT, depth), KEY), np.float64)
        # Rounding adds a twelfth of its square. The deviation of so many has a standard error of 0.5 %, its mean of
        # 0.7 % of the deviation; 1/z is not linear, which adds (deviation / z)^2 of z to the mean.
        spread = depth**2 * np.hypot(at_a_metre, step / np.sqrt(12.0))
        assert found.std() == pytest.approx(spread, rel=0.06)
        assert found.mean() == pytest.approx(depth, abs=0.05 * spread + 2.0 * spread**2 / depth)
        steps = 1.0 / found / step
        assert np.abs(steps - np.round(steps)).max() < 1e-2


def test_scene_units_scale_it_and_nothing_stays_nothing():
    depth = jnp.array([0.0, 1.0, 2.0, 3.0])
    metres = nbv.DepthNoise.kinect_v1().measured(depth, KEY)
    scene = nbv.DepthNoise.kinect_v1(scale=5.0).measured(5.0 * depth, KEY)
    np.testing.assert_allclose(scene, 5.0 * metres, rtol=1e-5)
    assert metres[0] == 0.0


def test_a_noisy_scan_is_an_image_of_the_same_rays():
    ball, pose, camera = nbv.SDFSurface(nbv.sdf.Sphere(0.8)), nbv.look_at((0.0, 0.0, 2.5)), nbv.Camera()
    seen = nbv.scan(ball, camera, pose)
    noisy = nbv.DepthNoise.kinect_v1(scale=2.5)(seen, KEY, camera, pose)
    np.testing.assert_array_equal(noisy.missed, seen.missed)
    both = np.asarray(noisy.mask)
    assert not np.any(both & ~np.asarray(seen.mask))
    # All but the limb, where a pixel has no plane.
    assert both.sum() > 0.8 * int(seen.count)
    outward = np.asarray(noisy.points)[both] / np.linalg.norm(np.asarray(noisy.points)[both], axis=1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip(np.sum(outward * np.asarray(noisy.normals)[both], axis=1), -1.0, 1.0)))
    assert np.median(angle) < 10.0
    exact = nbv.DepthNoise(0.0)(seen, KEY, camera, pose)
    off = np.linalg.norm(np.asarray(exact.points)[np.asarray(exact.mask)], axis=1) - 0.8
    assert np.median(np.abs(off)) < 2e-3
