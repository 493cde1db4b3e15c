"""Carving by the planner: carved samples, empty space passed to the model, and refused scans and observations."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_scenes import SEE, SOLIDS, image, nodes_of
from jaxtyping import Array, Float

import jaxnbv as nbv
from jaxnbv.scanning import carve
from jaxnbv.scanning.sdf import Cuboid

RNG = np.random.default_rng(0)
SMALL_GRID = nbv.Grid(30, 1.6)
POSES = [nbv.look_at((0.0, 0.3, 2.5)), nbv.look_at((0.0, 0.3, -2.5))]


class Waves(nbv.surfaces.Fields):
    """A ball under random waves, with dents and islands all over the scene, whatever was scanned."""

    phases: Float[Array, "s 3"]

    def __call__(self, x):
        waves = jnp.sin(6.0 * x[None] + self.phases[:, None]).sum(axis=-1)
        return jnp.linalg.norm(x, axis=-1) - 0.6 + waves


class WavesPosterior(nbv.surfaces.SurfacePosterior):
    level: Float[Array, ""]

    def sample(self, key, num_samples):
        return Waves(jax.random.uniform(key, (num_samples, 3), maxval=6.28))

    def mean(self, x):
        return jnp.linalg.norm(x, axis=-1) - 0.6

    def variance(self, x):
        return jnp.full(x.shape[0], 1.5)


class WavesModel(nbv.SurfaceModel):
    def condition(self, observations):
        return WavesPosterior(level=jnp.asarray(0.1))


CARVING, WAVES = nbv.Carving(), WavesModel()


def planner_of(carving=CARVING, model=WAVES):
    sampler = nbv.SurfaceSampler(model, SMALL_GRID, 3, carving)
    return nbv.Planner(
        nbv.Coverage(), nbv.FarthestView(12), nbv.Camera(height=40, width=40), sampler, capacity=400, max_views=4
    )


def after_both_sides(planner, surface, poses=POSES):
    observations = planner.init(poses[0], nbv.scan(surface, planner.camera, poses[0]))
    return planner.observe(observations, poses[1], nbv.scan(surface, planner.camera, poses[1]))


def test_no_sample_is_inside_what_was_seen_empty_nor_outside_the_volume():
    planner, raw = planner_of(), planner_of(carving=None)
    observations, raw_observations = (after_both_sides(one, SOLIDS["ball"]) for one in (planner, raw))
    assert raw_observations.empty_nodes is None
    expected = np.zeros((30,) * 3, bool)
    for pose in POSES:
        empty = SEE(CARVING, SMALL_GRID, pose, nbv.scan(SOLIDS["ball"], planner.camera, pose), planner.camera)
        assert empty.sum() > 200
        expected |= np.asarray(empty)
    np.testing.assert_array_equal(observations.empty_nodes, expected)

    carved = np.asarray(planner.sampler.sample(observations, jax.random.key(1)).values)
    values = np.asarray(raw.sampler.sample(raw_observations, jax.random.key(1)).values)
    outside = (np.linalg.norm(np.maximum(np.abs(nodes_of(SMALL_GRID)) - 1.25, 0.0), axis=-1)) > 2 * SMALL_GRID.spacing
    nowhere = expected | outside
    assert (outside & ~expected).any()
    assert (values[:, expected] < 0).any(), "there was nothing to carve"
    assert (values[:, outside] < 0).any(), "there was nothing to carve"
    assert (carved[:, nowhere] > 0).all()
    np.testing.assert_allclose(carved[:, ~nowhere], values[:, ~nowhere], atol=1e-5 * np.abs(values).max())
    # Carving makes no place more likely to be inside.
    assert ((carved < 0).mean(axis=0) <= (values < 0).mean(axis=0))[np.abs(values).min(axis=0) > 1e-4].all()


class Told(WavesModel):
    """A model whose level encodes the number of empty points that it gets, and how far the farthest lies outside the
    volume."""

    def condition(self, observations):
        empty = nbv.as_observations(observations).empty_points
        outermost = jnp.max(jnp.where(empty.mask, jnp.max(jnp.abs(empty.points), axis=1), 0.0))
        return WavesPosterior(level=1000.0 * jnp.sum(empty.mask) + outermost)


def test_the_model_gets_the_empty_space_within_the_volume():
    planner, waves = planner_of(model=Told()), planner_of(carving=None)
    observations = after_both_sides(planner, SOLIDS["ball"])
    within = observations.empty_nodes & CARVING.inside(SMALL_GRID)
    empty = dataclasses.replace(observations, empty_nodes=within).empty_points
    points = np.asarray(empty.points)[np.asarray(empty.mask)]
    assert 50 < len(points) <= 20**3
    index = np.rint((points + SMALL_GRID.half_extent) / SMALL_GRID.spacing).astype(int)
    assert np.asarray(observations.empty_nodes)[tuple(index.T)].all()
    assert np.abs(points).max() < 1.25
    key = jax.random.key(0)
    raw = waves.sampler.model.condition(observations.cloud).sample(key, 3).on_grid(SMALL_GRID.axis)
    untouched = ~np.asarray(observations.empty_nodes | CARVING.outside(SMALL_GRID))
    level = float((np.asarray(raw) - np.asarray(planner.sampler.sample(observations, key).values))[:, untouched].mean())
    np.testing.assert_allclose(level, 1000.0 * len(points) + np.abs(points).max(), rtol=1e-4)


ABOVE_AND_BELOW = [nbv.look_at((0.0, 0.0, 2.5)), nbv.look_at((0.0, 0.0, -2.5))]


def test_carved_samples_keep_a_thin_sheet_that_was_seen_from_both_sides():
    """Rays perpendicular to the sheet, from both sides, hit every sample there, as without carving."""
    model = nbv.GeometricSPSR(truncation=12, lengthscale=0.1)
    planner, raw = (planner_of(carving, model=model) for carving in (nbv.Carving(), None))
    sheet = nbv.SDFSurface(Cuboid([0.6, 0.6, 0.04]))
    observations = after_both_sides(planner, sheet, ABOVE_AND_BELOW)
    values = raw.sampler.sample(observations, jax.random.key(1)).values
    carved = carve(values, observations.empty_nodes | planner.sampler.carving.outside(SMALL_GRID))
    narrow, poses = (
        nbv.Camera(height=10, width=10, fov=0.35),
        nbv.look_at(jnp.asarray([[0.0, 0.0, 2.5], [0.0, 0.0, -2.5]])),
    )
    surfaces = nbv.scanning.GridSurface.from_values(jnp.concatenate([values, carved]), 0.0, SMALL_GRID)
    clouds = nbv.scanning.scan_samples(surfaces, narrow, poses)
    on_sheet = np.asarray(clouds.mask) & (np.abs(np.asarray(clouds.points)[..., 2]) < 2.0 * SMALL_GRID.spacing)
    before, after = on_sheet.reshape(2, 3, 2, -1).mean(axis=-1)
    assert (before > 0.5).all(), "the model does not see the sheet"
    assert (after >= before).all(), (before, after)


def test_a_scan_of_another_camera_needs_that_camera():
    planner, other, pose = planner_of(), nbv.Camera(height=20, width=36, fov=0.6), POSES[1]
    cloud = nbv.scan(SOLIDS["ball"], other, pose)
    expected = np.asarray(SEE(CARVING, SMALL_GRID, pose, cloud, other))
    column, row, _ = image(nodes_of(SMALL_GRID)[expected], other, pose)
    # The image is wider than the planner's.
    assert np.ptp(column) > 25
    assert np.ptp(row) > 10
    np.testing.assert_array_equal(planner.init(pose, cloud, camera=other).empty_nodes, expected)
    observations = planner.init(POSES[0], nbv.scan(SOLIDS["ball"], planner.camera, POSES[0]))
    after = planner.observe(observations, pose, cloud, camera=other)
    np.testing.assert_array_equal(after.empty_nodes, expected | np.asarray(observations.empty_nodes))
    for tell in (lambda: planner.init(pose, cloud), lambda: planner.observe(observations, pose, cloud)):
        with pytest.raises(ValueError, match=r"scan has 720 rays but the camera 40 x 40: give the camera that took it"):
            tell()


def test_a_cloud_that_is_no_image_carves_nothing():
    planner = planner_of()
    points = nbv.scan(SOLIDS["ball"], nbv.Camera(height=9, width=9), POSES[0])
    cloud = nbv.PointCloud.from_arrays(*points.to_numpy())
    assert cloud.missed is None
    observations = planner.init(POSES[0], cloud)
    assert not observations.empty_nodes.any()
    assert not planner.observe(observations, POSES[1], cloud).empty_nodes.any()
    unknown = planner.init(None, nbv.scan(SOLIDS["ball"], planner.camera, POSES[0]))
    assert not unknown.empty_nodes.any(), "nothing is known of a scan from an unknown pose"


def test_an_object_larger_than_its_volume_is_refused_and_one_that_fits_is_not():
    """The near side of the ball is at z = 0.65. Two margins are 0.22."""
    noisy = nbv.SensorNoise()(nbv.scan(SOLIDS["ball"], nbv.Camera(height=40, width=40), POSES[0]), jax.random.key(0))

    def boxed(half):
        return planner_of(nbv.Carving(nbv.Box((-half,) * 3, (half,) * 3)))

    small, fits = boxed(0.3), boxed(0.6)
    far = planner_of()
    assert int(fits.observe(fits.init(POSES[0], noisy), POSES[0], noisy).num_views) == 2
    speck = nbv.PointCloud.from_arrays([[0.0, 0.0, 0.1]], [[0.0, 0.0, 1.0]])
    for tell in (lambda: small.init(POSES[0], noisy), lambda: small.observe(small.init(None, speck), POSES[0], noisy)):
        with pytest.raises(
            ValueError, match=r"\d+ of \d+ .* up to 0\.\d+ outside the volume.*declare a larger one, Carving\(Box"
        ):
            tell()
    edge = nbv.PointCloud.from_arrays([[0.0, 0.0, 1.25 + 2.1 * SMALL_GRID.spacing]], [[0.0, 0.0, 1.0]])
    with pytest.raises(ValueError, match=r"outside the volume"):
        far.init(None, edge)
    np.testing.assert_array_equal(planner_of(carving=None).init(None, edge).cloud.count, 1)
    points = np.concatenate([0.1 * RNG.normal(size=(299, 3)), np.asarray(edge.points)])
    stray = nbv.PointCloud.from_arrays(points, np.tile([0.0, 0.0, 1.0], (300, 1)))
    np.testing.assert_array_equal(far.init(None, stray).cloud.count, 300)
