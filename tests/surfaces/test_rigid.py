"""Rigid registration of scans to meshes from any start; the outside of a mesh."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from jaxnbv.scanning.triangle_rays import first_faces
from jaxnbv.surfaces.rigid import orient_outward, register_scan

RNG = np.random.default_rng(0)


def bracket():
    """An L of two plates, 60 x 40 x 30, with a block on one, without symmetry."""
    foot, wall = trimesh.creation.box((60, 40, 6)), trimesh.creation.box((6, 40, 24))
    foot.apply_translation((30, 20, 3))
    wall.apply_translation((3, 20, 18))
    block = trimesh.creation.box((10, 12, 8))
    block.apply_translation((50, 10, 10))
    return trimesh.util.concatenate([foot, wall, block])


def shaft_with_flat():
    """A round shaft of radius 10 and length 40, cut flat at x = 8."""
    mesh = trimesh.creation.cylinder(10.0, 40.0, sections=240)
    mesh.vertices = np.minimum(mesh.vertices, [8.0, np.inf, np.inf])
    return mesh


def motion(rng):
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.random(random_state=rng.integers(1 << 30)).as_matrix()
    matrix[:3, 3] = 100.0 * rng.normal(size=3)
    return matrix


def scanned(mesh, ahead, rng, noise=0.0, count=3000):
    """Points of a mesh whose normals face `ahead`, and which nothing hides."""
    points, rows = trimesh.sample.sample_surface(mesh, count, seed=1)
    points, normals = np.asarray(points), mesh.face_normals[rows]
    direction = np.asarray(ahead) / np.linalg.norm(ahead)
    faces, _ = first_faces(mesh.vertices, mesh.faces)(points + 1e-3 * normals, np.tile(direction, (count, 1)))
    rows = (normals @ direction > 0.1) & (faces < 0)
    return points[rows] + noise * rng.normal(size=(rows.sum(), 3)), normals[rows]


def moved(matrix, points, normals):
    return points @ matrix[:3, :3].T + matrix[:3, 3], normals @ matrix[:3, :3].T


def off(mesh, change):
    """Mean distance from a mesh of its own points after a motion."""
    points = trimesh.transform_points(mesh.sample(2000, seed=2), change)
    return float(trimesh.proximity.closest_point_naive(mesh, points)[1].mean())


@pytest.mark.parametrize("ahead", [(1, 1, 1), (-1, 0.5, -0.7)])
def test_a_partial_noisy_scan_is_laid_on_its_part_from_anywhere(ahead):
    mesh, is_solid = orient_outward(bracket())
    truth = motion(RNG)
    points, normals = moved(truth, *scanned(mesh, ahead, RNG, noise=0.1))
    result = register_scan(points, normals, mesh, is_solid)
    np.testing.assert_allclose(result.matrix @ truth, np.eye(4), atol=0.1)
    assert result.median_distance < 0.1
    assert result.ambiguity == 0


def test_a_start_is_refined_and_its_neighbourhood_kept():
    mesh, is_solid = orient_outward(trimesh.creation.box((60, 40, 30)))
    points, normals = scanned(mesh, (1, 2, 3), RNG)
    # The box looks the same after a rotation by 180 degrees.
    for truth in (np.eye(4), trimesh.transformations.rotation_matrix(np.pi, (0, 0, 1))):
        near = trimesh.transformations.rotation_matrix(0.15, (1, 2, 0), (5, 0, 0)) @ truth
        result = register_scan(points, normals, mesh, is_solid, near)
        np.testing.assert_allclose(result.matrix, truth, atol=1e-4)


def test_a_symmetric_part_has_no_rival():
    mesh, is_solid = orient_outward(trimesh.creation.box((60, 40, 30)))
    truth = motion(RNG)
    result = register_scan(*moved(truth, *scanned(mesh, (1, 2, 3), RNG, noise=0.05)), mesh, is_solid)
    assert off(mesh, result.matrix @ truth) < 0.05
    assert result.ambiguity == 0


def test_the_flat_of_a_shaft_determines_its_rotation():
    mesh, is_solid = orient_outward(shaft_with_flat())
    truth = motion(RNG)
    result = register_scan(*moved(truth, *scanned(mesh, (1, 0.4, 0.6), RNG, noise=0.05)), mesh, is_solid)
    # It may be turned end for end about the normal of the flat.
    assert (result.matrix @ truth)[0, 0] == pytest.approx(1.0, abs=1e-3)


def test_a_face_that_can_slide_has_a_rival():
    mesh, is_solid = orient_outward(bracket())
    points, normals = scanned(mesh, (0, 0, -1), RNG)
    patch = (points[:, 0] > 15) & (points[:, 0] < 40)
    assert register_scan(points[patch], normals[patch], mesh, is_solid).ambiguity > 1.0


def test_faces_are_wound_outward_however_they_were_wound():
    box = trimesh.creation.box((3, 2, 1))
    inverted = box.copy()
    inverted.invert()
    mixed = box.copy()
    mixed.faces[::3] = mixed.faces[::3, ::-1]
    soup = trimesh.Trimesh(box.triangles.reshape(-1, 3), np.arange(36).reshape(-1, 3), process=False)
    without_lid = trimesh.Trimesh(box.vertices, box.faces[box.face_normals[:, 2] < 0.5], process=False)
    for cad in (box, inverted, mixed, soup, without_lid):
        mesh, is_solid = orient_outward(cad)
        assert is_solid
        assert len(mesh.vertices) == 8
        assert np.all(np.sum(mesh.triangles_center * mesh.face_normals, axis=1) > 0)


def test_a_sheet_keeps_its_winding():
    sheet = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]], process=False)
    for cad in (sheet, trimesh.Trimesh(sheet.vertices, sheet.faces[:, ::-1], process=False)):
        mesh, is_solid = orient_outward(cad)
        assert not is_solid
        np.testing.assert_allclose(mesh.face_normals, cad.face_normals)
