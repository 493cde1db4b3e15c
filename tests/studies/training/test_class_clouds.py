"""Training clouds: what they hold, that they can be made again, and that splits differ."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnbv.imagination import Imagination
from jaxnbv.planning.planner import Planner
from jaxnbv.scanning import Grid
from jaxnbv.studies.scenes import CLASS_SETS, PATTERNS, Framing, Split, pyramid_scene
from jaxnbv.studies.training.class_clouds import MAX_VIEWS, imagined_clouds, scanned_clouds
from jaxnbv.surfaces import GeometricSPSR
from jaxnbv.tasks import Coverage

COUNT, POINTS = 16, 200
# So many scenes at a time share one program.
PORTION = 8
# The scenes of these rows again, in a portion of their own.
FEW = slice(4, 7)
MODEL = GeometricSPSR(lengthscale=0.05, truncation=8)
PLANNER = Planner(Coverage(), imagination=Imagination(MODEL, grid=Grid(20), num_samples=2), capacity=150)


def portion_of(split, framing, first, count):
    return scanned_clouds(CLASS_SETS["pyramid"], split, framing, range(first, first + count), POINTS)


def clouds_of(split, first, count, framing=Framing.CLOSE_UP):
    portions = [portion_of(split, framing, first + i, PORTION) for i in range(0, count, PORTION)]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *portions)


def imagined_of(index):
    return imagined_clouds(CLASS_SETS["pyramid"], Split.TRAIN, Framing.CLOSE_UP, index, PLANNER, 3, POINTS)


@pytest.fixture(scope="module")
def scanned():
    return clouds_of(Split.TRAIN, 5, COUNT)


@pytest.fixture(scope="module")
def imagined():
    return [imagined_of(index) for index in (5, 6)]


@eqx.filter_jit
def distances(solid, x):
    return solid(x)


def own_frame(pyramid, points):
    """Points in the frame of the pyramid."""
    offset, rotation, scale = map(np.asarray, (pyramid.offset, pyramid.rotation, pyramid.scale))
    return (points - offset) @ rotation / scale


def assert_same(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.mark.slow
def test_scanned_clouds_are_samples_of_their_scenes_with_noise(scanned):
    np.testing.assert_array_equal(scanned.labels, np.arange(5, 5 + COUNT) % len(PATTERNS))
    assert not np.asarray(scanned.imagined).any()
    assert scanned.clouds.points.shape == (COUNT, POINTS, 3)
    assert np.asarray(scanned.clouds.count > 50).all()
    for row in range(COUNT):
        _, normals = scanned.clouds[row].to_numpy()
        off = distances(pyramid_scene(Split.TRAIN, 5 + row), scanned.clouds.points[row])
        off = np.asarray(off)[scanned.clouds.mask[row]]
        # Farthest point samples favour what noise moves out: its standard deviation is 0.01 along each axis.
        assert np.abs(off).max() < 0.06
        assert 0.004 < off.std() < 0.025
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)


@pytest.mark.slow
def test_telling_pixels_vary_and_are_at_most_those_of_one_view(scanned):
    pixels = np.asarray(scanned.cue_pixels)
    assert pixels.min() >= 0
    assert pixels.max() <= 2500
    views = np.asarray(scanned.views)
    assert views.min() >= 1
    assert views.max() == MAX_VIEWS
    assert len(np.unique(views)) >= 3
    assert (pixels >= 500).sum() >= 3
    assert len(np.unique(pixels)) > COUNT // 2


def test_a_cloud_whose_views_miss_the_pattern_has_no_point_in_it():
    """And one with many pixels does; half the depth of the pattern is more than three deviations of the noise."""
    found = clouds_of(Split.VALIDATION, 0, 24)
    shares = {False: [], True: []}
    for row, pixels in enumerate(np.asarray(found.cue_pixels)):
        pyramid = pyramid_scene(Split.VALIDATION, row)
        points, _ = found.clouds[row].to_numpy()
        own = own_frame(pyramid, points)
        side = (np.abs(own[:, :2]).max(axis=1) - 1) * float(pyramid.height) + own[:, 2]
        inner = (own[:, 2] > 0.5 * float(pyramid.depth)) & (side < -0.12)
        if pixels == 0 or pixels > 500:
            shares[bool(pixels)].append(inner.mean())
    assert len(shares[False]) >= 2
    assert len(shares[True]) >= 5
    assert max(shares[False]) < 0.01
    assert min(shares[True]) > 0.02


def test_points_that_tell_the_class_lie_on_what_tells_it(scanned):
    """In a pyramid's own frame, up to three deviations of the noise: above the base and in the pattern."""
    counted = np.asarray(scanned.on_cue).sum(axis=1)
    assert not (np.asarray(scanned.on_cue) & ~np.asarray(scanned.clouds.mask)).any()
    assert counted[np.asarray(scanned.cue_pixels) >= 500].min() > 10
    for row in range(COUNT):
        pyramid = pyramid_scene(Split.TRAIN, 5 + row)
        tells = np.asarray(scanned.on_cue[row])
        own = own_frame(pyramid, np.asarray(scanned.clouds.points[row]))
        assert (own[tells, 2] * float(pyramid.scale) > 0.03 - 1e-4).all()
        assert (own[tells, 2] < float(pyramid.depth) + 0.04).all()


@pytest.mark.slow
def test_clouds_can_be_made_again_in_other_portions(scanned):
    assert_same(scanned, clouds_of(Split.TRAIN, 5, COUNT))
    part = portion_of(Split.TRAIN, Framing.CLOSE_UP, 5 + FEW.start, FEW.stop - FEW.start)
    np.testing.assert_array_equal(part.cue_pixels, scanned.cue_pixels[FEW])
    np.testing.assert_allclose(part.clouds.points, scanned.clouds.points[FEW], atol=1e-5)


def test_splits_and_framings_differ(scanned):
    other = clouds_of(Split.TEST, 5, COUNT)
    assert not np.array_equal(other.cue_pixels, scanned.cue_pixels)
    whole = clouds_of(Split.TRAIN, 5, COUNT, Framing.WHOLE)
    np.testing.assert_array_equal(whole.labels, scanned.labels)
    assert (
        np.abs(np.asarray(whole.clouds.points)).max() < 0.625 + 0.06 < np.abs(np.asarray(scanned.clouds.points)).max()
    )


@pytest.mark.slow
def test_imagined_clouds_begin_with_what_was_truly_seen(imagined):
    for index, found in zip((5, 6), imagined, strict=True):
        assert found.clouds.points.shape == (6, POINTS, 3)
        assert np.asarray(found.imagined).all()
        np.testing.assert_array_equal(found.labels, index % len(PATTERNS))
        assert len(np.unique(found.cue_pixels)) == 1
        pyramid = pyramid_scene(Split.TRAIN, index)
        clouds = [found.clouds[row].to_numpy() for row in range(6)]
        off = np.abs(np.asarray(distances(pyramid, found.clouds.points)))
        on_surface = np.sum((off < 0.04) & np.asarray(found.clouds.mask), axis=1)
        for (points, normals), count in zip(clouds, on_surface, strict=True):
            assert np.isfinite(points).all()
            np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-4)
            # Some of the points are D's, on the true surface; the sample's are not all.
            assert 20 < count <= len(points)
        shared = {tuple(p) for p in clouds[0][0]} & {tuple(p) for p in clouds[1][0]}
        assert 5 < len(shared) < len(clouds[0][0])
        assert len({points.tobytes() for points, _ in clouds}) == 6


@pytest.mark.slow
def test_imagined_clouds_can_be_made_again(imagined):
    again = imagined_of(6)
    assert_same(imagined[1], again)
    assert not np.array_equal(imagined[0].clouds.points, imagined[1].clouds.points)
