"""Training clouds: their contents, reproducibility, and differences between splits."""

import equinox as eqx
import jax
import numpy as np
import pytest
from scipy.spatial import cKDTree
from training_clouds import MAX_VIEWS, Source, imagined_clouds, scanned_clouds

import jaxnbv as nbv
from jaxnbv.studies.scenes import PATTERNS, Split, part_scene, pyramid_scene
from jaxnbv.studies.sensors import PART_SETTING

COUNT, POINTS = 24, 200
MODEL = nbv.GeometricSPSR(lengthscale=0.05, truncation=8)
PLANNER = nbv.Planner(nbv.Coverage(), sampler=nbv.SurfaceSampler(MODEL, grid=nbv.Grid(20), num_samples=2), capacity=150)
# A motorbike and a skateboard. For more objects compilation would take nearly all the time.
PARTS, SETTING = (7, 11), PART_SETTING._replace(camera=nbv.Camera(height=24, width=24))


@pytest.fixture(scope="module")
def scanned():
    return scanned_clouds(pyramid_scene, Split.TRAIN, range(5, 5 + COUNT), POINTS)


@pytest.fixture(scope="module")
def imagined():
    return imagined_clouds(pyramid_scene, Split.TRAIN, 5, PLANNER, POINTS)


@eqx.filter_jit
def distances(solid, x):
    return solid(x)


def own_frame(pyramid, points):
    """Points in the frame of the pyramid."""
    offset, rotation, scale = map(np.asarray, (pyramid.solid.offset, pyramid.solid.rotation, pyramid.solid.scale))
    return (points - offset) @ rotation / scale


def test_scanned_clouds_are_samples_of_their_scenes_with_noise(scanned):
    np.testing.assert_array_equal(scanned.labels, np.arange(5, 5 + COUNT) % len(PATTERNS))
    assert scanned.clouds.points.shape == (COUNT, POINTS, 3)
    assert not np.asarray(scanned.imagined).any()
    assert {*np.asarray(scanned.views).tolist()} == {*range(1, MAX_VIEWS + 1)}
    assert np.asarray(scanned.clouds.count > 50).all()
    for row in range(COUNT):
        _, normals = scanned.clouds[row].to_numpy()
        off = distances(pyramid_scene(Split.TRAIN, 5 + row), scanned.clouds.points[row])
        off = np.asarray(off)[scanned.clouds.mask[row]]
        # Farthest point sampling prefers points that noise moves outwards. Its standard deviation is 0.01 along each
        # axis.
        assert np.abs(off).max() < 0.06
        assert 0.004 < off.std() < 0.025
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)


def test_points_that_tell_the_class_lie_in_the_pattern_where_a_view_shows_it(scanned):
    """In a pyramid's own frame, up to three deviations of the noise. Half the pattern's depth is more than that."""
    shares = {False: [], True: []}
    tells, mask = np.asarray(scanned.point_labels), np.asarray(scanned.clouds.mask)
    assert not (tells & ~mask).any()
    for row, pixels in enumerate(np.asarray(scanned.cue_pixels)):
        pyramid = pyramid_scene(Split.TRAIN, 5 + row)
        own = own_frame(pyramid, np.asarray(scanned.clouds.points[row]))
        assert (own[tells[row], 2] * float(pyramid.solid.scale) > 0.03 - 1e-4).all()
        assert (own[tells[row], 2] < float(pyramid.solid.depth) + 0.04).all()
        side = (np.abs(own[:, :2]).max(axis=1) - 1) * float(pyramid.solid.height) + own[:, 2]
        inner = mask[row] & (own[:, 2] > 0.5 * float(pyramid.solid.depth)) & (side < -0.12)
        if pixels == 0 or pixels > 500:
            shares[bool(pixels)].append((inner.sum() / mask[row].sum(), tells[row].sum()))
    unseen, visible = (np.array(shares[key]) for key in (False, True))
    assert len(unseen) >= 2
    assert len(visible) >= 5
    assert unseen.max(axis=0)[0] < 0.01
    assert (visible.min(axis=0) > (0.02, 10)).all()
    assert np.asarray(scanned.cue_pixels).max() <= 2500


def test_clouds_can_be_made_again_in_other_portions_and_splits_differ(scanned):
    few = slice(4, 7)
    part = scanned_clouds(pyramid_scene, Split.TRAIN, range(5, 5 + COUNT)[few], POINTS)
    np.testing.assert_array_equal(part.cue_pixels, scanned.cue_pixels[few])
    np.testing.assert_allclose(part.clouds.points, scanned.clouds.points[few], atol=1e-5)
    other = scanned_clouds(pyramid_scene, Split.TEST, range(5, 5 + COUNT)[few], POINTS)
    assert not np.array_equal(other.cue_pixels, part.cue_pixels)


@pytest.mark.slow
def test_imagined_clouds_begin_with_what_was_truly_seen(imagined):
    assert imagined.clouds.points.shape == (8, POINTS, 3)
    assert np.asarray(imagined.imagined).all()
    np.testing.assert_array_equal(imagined.labels, 0)
    assert len(np.unique(imagined.cue_pixels)) == 1
    clouds = [imagined.clouds[row].to_numpy() for row in range(8)]
    off = np.abs(np.asarray(distances(pyramid_scene(Split.TRAIN, 5), imagined.clouds.points)))
    on_surface = np.sum((off < 0.04) & np.asarray(imagined.clouds.mask), axis=1)
    for (points, normals), count in zip(clouds, on_surface, strict=True):
        assert np.isfinite(points).all()
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-4)
        # Some of the points are D's, on the true surface. Some of the sample's points are not on it.
        assert 20 < count <= len(points)
    shared = {tuple(p) for p in clouds[0][0]} & {tuple(p) for p in clouds[1][0]}
    assert 5 < len(shared) < len(clouds[0][0])
    assert len({points.tobytes() for points, _ in clouds}) == 8


@pytest.mark.slow
def test_clouds_are_kept_in_the_units_of_the_network(tmp_path, monkeypatch):
    monkeypatch.setattr("training_clouds._SCENES_PER_FILE", 3)
    source = Source(tmp_path, pyramid_scene, PLANNER, POINTS, scale=2.0)
    batch = source.scanned(Split.TEST, 6)
    again = scanned_clouds(pyramid_scene, Split.TEST, range(6), POINTS)
    np.testing.assert_allclose(batch.clouds.points, 2.0 * again.clouds.points, atol=2e-5)
    np.testing.assert_array_equal(batch.labels, again.labels)
    monkeypatch.setattr("training_clouds.scanned_clouds", None)
    for one, other in zip(jax.tree.leaves(source.scanned(Split.TEST, 6)), jax.tree.leaves(batch), strict=True):
        np.testing.assert_array_equal(one, other)


@eqx.filter_jit
def surface_points(solid):
    """Noiseless hits from many sides, by another camera than that of the clouds, with their labels."""
    camera = nbv.Camera(fov=1.0, height=64, width=64)
    hits = jax.lax.map(
        lambda pose: nbv.scan(nbv.SDFSurface(solid), camera, pose), nbv.look_at(nbv.geometry.fibonacci_sphere(16, 2.7))
    )
    return hits.points.reshape(-1, 3), solid.part_labels(hits.points).reshape(-1), hits.mask.reshape(-1)


@pytest.mark.slow
def test_points_of_parts_have_the_label_of_the_surface_nearby():
    batch = scanned_clouds(part_scene, Split.TRAIN, PARTS, POINTS, SETTING)
    for row, index in enumerate(PARTS):
        scene = part_scene(Split.TRAIN, index)
        assert int(batch.labels[row]) == int(scene.category)
        points, labels, mask = (np.asarray(one) for one in surface_points(scene.solid))
        points, labels = points[mask], labels[mask]
        there = np.asarray(batch.clouds.mask[row])
        noisy, own = np.asarray(batch.clouds.points[row])[there], np.asarray(batch.point_labels[row])[there]
        assert np.asarray(scene.parts)[own].all()
        # Six deviations of the noise.
        near = cKDTree(points).query_ball_point(noisy, 0.06)
        alike = [set(labels[index]) for index in near]
        assert np.mean([len(some) > 0 for some in alike]) > 0.9
        sure = [(some, label) for some, label in zip(alike, own, strict=True) if len(some) == 1]
        assert len(sure) > 0.3 * there.sum()
        assert np.mean([label in some for some, label in sure]) > 0.99
