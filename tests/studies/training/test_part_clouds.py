"""Clouds with parts: labels are those of the surface, portions and splits do not matter to one another."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import fibonacci_sphere, look_at
from jaxnbv.imagination import Imagination
from jaxnbv.planning.planner import Planner
from jaxnbv.scanning import Grid, SDFSurface, scan
from jaxnbv.studies.scenes import Split, part_scene
from jaxnbv.studies.training import part_clouds
from jaxnbv.studies.training.part_clouds import imagined_part_clouds, scanned_part_clouds
from jaxnbv.surfaces import GeometricSPSR
from jaxnbv.tasks import Coverage

# A motorbike and a skateboard.
SCENES, POINTS = (7, 11), 150
# Compilation takes nearly all the time of the rest.
CAMERA = Camera(height=24, width=24)
MODEL = GeometricSPSR(lengthscale=0.05, truncation=8)
PLANNER = Planner(Coverage(), camera=CAMERA, imagination=Imagination(MODEL, grid=Grid(20), num_samples=2), capacity=150)


@pytest.fixture(scope="module")
def scenes():
    return [part_scene(Split.TRAIN, index) for index in SCENES]


@pytest.fixture(scope="module")
def scanned():
    return scanned_part_clouds(Split.TRAIN, SCENES, POINTS, CAMERA)


@pytest.fixture(scope="module")
def imagined():
    return imagined_part_clouds(Split.TRAIN, SCENES, PLANNER, 3, POINTS, CAMERA)


@eqx.filter_jit
def surface_points(solid):
    """Noiseless hits from many sides, by another camera than the clouds', with their labels."""
    camera = Camera(fov=1.0, height=64, width=64)
    hits = jax.lax.map(lambda pose: scan(SDFSurface(solid), camera, pose), look_at(fibonacci_sphere(16, 2.7)))
    return hits.points.reshape(-1, 3), solid.label(hits.points).reshape(-1), hits.mask.reshape(-1)


@eqx.filter_jit
def distances(solid, x):
    return solid(x)


@eqx.filter_jit
def labels_at(solid, x):
    return solid.label(x)


@pytest.mark.slow
def test_labels_are_those_of_the_surface_nearby(scanned, scenes):
    assert scanned.clouds.points.shape == (6, POINTS, 3)
    assert scanned.labels.shape == (6, POINTS)
    surfaces = [tuple(map(np.asarray, surface_points(scene.solid))) for scene in scenes]
    for row in range(6):
        scene = scenes[row // 3]
        assert int(scanned.categories[row]) == int(scene.category)
        points, labels, mask = surfaces[row // 3]
        points, labels = points[mask], labels[mask]
        there = np.asarray(scanned.clouds.mask[row])
        noisy, own = np.asarray(scanned.clouds.points[row])[there], np.asarray(scanned.labels[row])[there]
        assert np.asarray(scene.parts)[own].all()
        # Six deviations of the noise.
        near = cKDTree(points).query_ball_point(noisy, 0.06)
        alike = [set(labels[index]) for index in near]
        assert np.mean([len(found) > 0 for found in alike]) > 0.9
        sure = [(found, label) for found, label in zip(alike, own, strict=True) if len(found) == 1]
        assert len(sure) > 0.3 * there.sum()
        assert np.mean([label in found for found, label in sure]) > 0.99
        off = np.asarray(distances(scene.solid, scanned.clouds.points[row]))[there]
        assert np.abs(off).max() < 0.07
        assert 0.003 < off.std() < 0.025


@pytest.mark.slow
def test_points_are_there_once_and_oriented(scanned, imagined):
    for clouds in (scanned.clouds, imagined.clouds):
        mask = np.asarray(clouds.mask)
        assert mask.sum() > 0.3 * mask.size
        np.testing.assert_allclose(np.linalg.norm(np.asarray(clouds.normals)[mask], axis=-1), 1.0, atol=1e-5)
        for points, filled in zip(np.asarray(clouds.points), mask, strict=True):
            assert len(np.unique(points[filled], axis=0)) == filled.sum()


@pytest.mark.parametrize("filled", [5, 12, 20])
def test_thinned_points_keep_their_labels_and_spare_rows_hold_nothing(filled):
    rng = np.random.default_rng(filled)
    mask = np.isin(np.arange(20), rng.permutation(20)[:filled])
    rows = rng.normal(size=(20, 3)).astype(np.float32)
    cloud = PointCloud(jnp.asarray(rows), jnp.asarray(-rows), jnp.asarray(mask))
    thinned, labels = part_clouds._thin(cloud, jnp.arange(20), 12)
    count = min(filled, 12)
    np.testing.assert_array_equal(thinned.mask, np.arange(12) < count)
    kept = np.asarray(labels)[:count]
    assert mask[kept].all()
    assert len(set(kept.tolist())) == count
    np.testing.assert_array_equal(thinned.points[:count], rows[kept])
    np.testing.assert_array_equal(thinned.normals[:count], -rows[kept])
    assert not np.asarray(thinned.points[count:]).any()
    assert not np.asarray(thinned.normals[count:]).any()


@pytest.mark.slow
def test_clouds_of_a_scene_are_of_different_views_and_samples(scanned, imagined):
    assert imagined.clouds.points.shape == (2 * 2 * 3, POINTS, 3)
    assert len({np.asarray(points).tobytes() for points in scanned.clouds.points}) == 6
    assert len({np.asarray(points).tobytes() for points in imagined.clouds.points}) == 12


def test_imagined_points_have_the_label_of_the_part_nearest_in_truth(imagined, scenes):
    for row in range(12):
        scene = scenes[row // 6]
        assert int(imagined.categories[row]) == int(scene.category)
        there = np.asarray(imagined.clouds.mask[row])
        nearest, own = (
            np.asarray(labels)[there]
            for labels in (labels_at(scene.solid, imagined.clouds.points[row]), imagined.labels[row])
        )
        # Of scanned points, which keep the label that they had before the noise, those at a boundary may differ.
        assert np.mean(nearest == own) > 0.93
        assert np.asarray(scene.parts)[own].all()


def test_order_does_not_matter_and_splits_do(scanned):
    turned = scanned_part_clouds(Split.TRAIN, SCENES[::-1], POINTS, CAMERA)
    np.testing.assert_array_equal(turned.labels[:3], scanned.labels[3:])
    np.testing.assert_allclose(turned.clouds.points[:3], scanned.clouds.points[3:], atol=1e-5)
    other = scanned_part_clouds(Split.TEST, SCENES, POINTS, CAMERA)
    np.testing.assert_array_equal(other.categories, scanned.categories)
    shared = np.isin(other.clouds.points[other.clouds.mask], scanned.clouds.points[scanned.clouds.mask])
    assert shared.mean() < 0.01
