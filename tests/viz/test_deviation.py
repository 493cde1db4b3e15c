"""Comparison of scans with CAD: boxes with dents and bumps of known shape, spheres and sheets, in millimetres."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import jaxnbv as nbv
from jaxnbv.checks import InputError

RNG = np.random.default_rng(0)
SIDES = np.array([100.0, 60.0, 40.0])
BOX = trimesh.creation.box(SIDES)
# Place of the flaw on the top of the box, its radius there, and its height.
PLACE, RADIUS, HEIGHT = np.array([20.0, -8.0]), 9.0, 2.0
SPHERE = (RADIUS**2 + HEIGHT**2) / (2.0 * HEIGHT)  # Radius of the sphere that the flaw is a cap of.


def scanned_box(height, noise=0.0, count=6000):
    """Points and normals of the three sides of the box that meet at a corner, and their distances from the box."""
    axis = np.repeat(np.arange(3), count // 3)
    points, normals = (RNG.random((len(axis), 3)) - 0.5) * SIDES, np.eye(3)[axis]
    points[np.arange(len(axis)), axis] = 0.5 * SIDES[axis]
    across = points[:, :2] - PLACE
    squared, sign = np.sum(across**2, axis=1), np.sign(height)
    is_cap = (axis == 2) & (squared < RADIUS**2)
    root = np.sqrt(SPHERE**2 - np.minimum(squared, RADIUS**2))
    distances = np.where(is_cap, sign * (root - (SPHERE - HEIGHT)), 0.0)
    points[:, 2] += distances
    normals[:, :2] += np.where(is_cap[:, None], sign * across / root[:, None], 0.0)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return points + noise * RNG.normal(size=(len(points), 1)) * normals, normals, distances


def motion(seed, far=200.0):
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    matrix[:3, 3] = far * np.random.default_rng(seed).normal(size=3)
    return matrix


def cloud(points, normals, matrix=np.eye(4)):  # noqa: B008
    return nbv.PointCloud.from_arrays(points @ matrix[:3, :3].T + matrix[:3, 3], normals @ matrix[:3, :3].T)


def test_a_dent_is_found_on_a_partial_noisy_scan_from_anywhere():
    matrix = motion(4)
    points, normals, distances = scanned_box(-HEIGHT, noise=0.05)
    result = nbv.deviation(cloud(points, normals, matrix), BOX)
    # A box looks the same in four poses. In all of them its surface is that of the scanned box.
    motion_of_box = np.linalg.inv(matrix) @ result.pose
    np.testing.assert_allclose(np.abs(motion_of_box[:3, :3]), np.eye(3), atol=2e-3)
    np.testing.assert_allclose(motion_of_box[:3, 3], 0.0, atol=0.05)
    error = result.distances - distances
    assert np.abs(np.median(error)) < 0.01
    assert np.percentile(np.abs(error), 99) < 0.2
    assert result.median == pytest.approx(0.05 * 0.674, rel=0.5)

    first, second = result.worst(2)
    top = np.linalg.inv(matrix) @ [*first.position, 1.0]
    np.testing.assert_allclose(top[:2], PLACE, atol=3.0)
    assert first.distance == pytest.approx(-HEIGHT, abs=0.15)
    # At this radius half of the cap's height is left.
    half = np.sqrt(SPHERE**2 - (SPHERE - 0.5 * HEIGHT) ** 2)
    assert first.extent == pytest.approx(2.0 * half, abs=3.0)
    assert abs(second.distance) < 0.2


def test_half_of_a_box_is_missing_where_three_of_its_sides_were_scanned():
    points, normals, _ = scanned_box(-HEIGHT)
    result = nbv.deviation(cloud(points, normals), BOX, register=False)
    assert result.area + result.missing_area == pytest.approx(BOX.area)
    assert result.missing_area / BOX.area == pytest.approx(0.5, abs=0.03)
    front, back = np.array([[0.0, 10.0, 20.0]]), np.array([[0.0, 10.0, -20.0]])
    assert result.values_at(front, np.array([[0.0, 0.0, 1.0]])) == pytest.approx(0.0, abs=1e-4)
    assert np.isnan(result.values_at(back, np.array([[0.0, 0.0, -1.0]])))


def test_a_sphere_that_is_too_small_is_so_everywhere():
    ball, more = trimesh.creation.icosphere(subdivisions=3, radius=30.0), -0.8
    scan = trimesh.creation.icosphere(subdivisions=3, radius=30.0 + more)
    scan.apply_translation((50, 20, -70))
    result = nbv.deviation(scan, ball)
    # The facets of both are up to 0.1 inside their spheres.
    np.testing.assert_allclose(result.distances, more, atol=0.2)
    np.testing.assert_allclose(result.pose[:3, 3], [50, 20, -70], atol=0.1)
    assert result.missing_area < 1e-3 * result.area
    (place,) = result.worst()
    assert place.distance == pytest.approx(more, abs=0.2)
    assert place.extent == pytest.approx(2.0 * (30.0 + more), rel=0.02)


@settings(max_examples=3)
@given(seed=st.integers(0, 10**6))
def test_a_rigid_motion_of_both_changes_nothing(seed):
    matrix = motion(seed)
    points, normals, _ = scanned_box(HEIGHT, noise=0.2, count=900)
    before = nbv.deviation(cloud(points, normals), BOX, register=False)
    scan, cad = cloud(points, normals, matrix), BOX.copy().apply_transform(matrix)
    for after in (nbv.deviation(scan, cad, register=False), nbv.deviation(scan, BOX, matrix, register=False)):
        # Clouds are in single precision.
        np.testing.assert_allclose(after.distances, before.distances, atol=1e-3)
        np.testing.assert_allclose(
            after.nearest_points, trimesh.transform_points(before.nearest_points, matrix), atol=1e-3
        )
        assert after.missing_area == pytest.approx(before.missing_area, rel=0.01)
        assert [place.distance for place in after.worst()] == pytest.approx(
            [p.distance for p in before.worst()], abs=1e-3
        )


def test_a_start_is_refined_and_a_symmetric_pose_is_kept():
    points, normals, _ = scanned_box(HEIGHT)
    turned = trimesh.transformations.rotation_matrix(np.pi, (0, 0, 1))
    near = trimesh.transformations.rotation_matrix(0.1, (1, 2, 0), (30, 0, 0)) @ turned
    result = nbv.deviation(cloud(points, normals), BOX, near)
    np.testing.assert_allclose(result.pose, turned, atol=1e-3)


def test_an_open_cad_has_an_inside_a_sheet_a_front_and_a_wall_two_sides():
    without_lid = trimesh.Trimesh(BOX.vertices, BOX.faces[BOX.face_normals[:, 2] < 0.5], process=False)
    sheet = trimesh.Trimesh(BOX.vertices, BOX.faces[BOX.face_normals[:, 0] > 0.5], process=False)
    side = np.column_stack([np.full(400, 50.0), (RNG.random((400, 2)) - 0.5) * [50.0, 30.0]])
    outward = np.tile([1.0, 0.0, 0.0], (400, 1))
    for cad in (BOX, without_lid, sheet):
        for off in (0.7, -0.7):
            result = nbv.deviation(cloud(side + off * outward, outward), cad, register=False)
            np.testing.assert_allclose(result.distances, off, atol=1e-4)
    # The scan of one side of a wall does not cover the other.
    places = np.column_stack([(RNG.random((4000, 2)) - 0.5) * [80.0, 50.0], np.full(4000, 0.2)])
    scan, wall = cloud(places, np.tile([0.0, 0.0, 1.0], (4000, 1))), trimesh.creation.box((80, 50, 0.4))
    assert nbv.deviation(scan, wall, register=False).area == pytest.approx(80.0 * 50.0, rel=0.03)


@pytest.fixture(scope="module")
def marked():
    """A box whose top is imagined, 3 mm too high."""
    mesh = BOX.subdivide().subdivide()
    is_top = mesh.face_normals[:, 2] > 0.5
    mesh.unmerge_vertices()
    mesh.vertices[mesh.faces[is_top]] += [0.0, 0.0, 3.0]
    mesh.face_attributes["measured"] = (~is_top).astype(np.uint8)
    return mesh


def test_only_measured_faces_are_compared(marked, tmp_path):
    path = tmp_path / "scan.ply"
    path.write_bytes(marked.export(file_type="ply"))
    top = SIDES[0] * SIDES[1]
    for scan in (marked, str(path)):
        result = nbv.deviation(scan, BOX, register=False)
        assert result.imagined == pytest.approx(top / BOX.area, rel=1e-3)
        assert result.percentile(100.0) < 1e-3
        assert result.missing_area == pytest.approx(top, rel=0.05)
    plain = trimesh.Trimesh(marked.vertices, marked.faces, process=False)
    result = nbv.deviation(plain, BOX, register=False)
    assert (result.imagined, result.percentile(100.0)) == pytest.approx((0.0, 3.0), abs=1e-3)


def test_cad_comes_as_a_file_a_mesh_or_a_scene_in_its_own_units(tmp_path):
    path = tmp_path / "box.stl"
    BOX.export(path)
    points, normals, distances = scanned_box(HEIGHT)
    scan = cloud(points, normals)
    for cad in (path, BOX.scene(), nbv.load_mesh(path, up="z"), nbv.TriangleMesh(BOX.vertices, BOX.faces, nbv.Frame())):
        np.testing.assert_allclose(nbv.deviation(scan, cad, register=False).distances, distances, atol=1e-3)


def test_places_stand_apart_and_flanks_are_none():
    places = (np.stack(np.meshgrid(*[np.arange(-49.5, 50)] * 2), axis=-1).reshape(-1, 2)) * [1.0, 0.6]
    flaws = {(-30.0, 0.0): 2.0, (0.0, 5.0): -1.5, (30.0, -9.0): 0.6, (34.0, -9.0): 0.5}
    height = sum(size * np.exp(-np.sum((places - at) ** 2, axis=1) / 18.0) for at, size in flaws.items())
    points = np.column_stack([places, 20.0 + height])
    result = nbv.deviation(cloud(points, np.tile([0.0, 0.0, 1.0], (len(points), 1))), BOX, register=False)
    worst = result.worst(3)
    for place, at in zip(worst, [(-30.0, 0.0), (0.0, 5.0), (32.0, -9.0)], strict=True):
        np.testing.assert_allclose(place.position[:2], at, atol=2.0)
    assert [np.sign(place.distance) for place in worst] == [1, -1, 1]
    # Full width at half maximum of a Gaussian with standard deviation 3.
    assert worst[1].extent == pytest.approx(2.355 * 3.0, abs=2.0)
    assert [place.distance for place in result.worst(2, min_distance=70.0)] == pytest.approx([2.0, 0.0], abs=0.2)


def test_a_scan_of_another_part_or_with_a_pose_that_is_not_unique_is_warned_of():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=40.0)
    with pytest.warns(UserWarning, match="fits the scan poorly: the median distance is"):
        nbv.deviation(ball, trimesh.creation.box((20, 30, 120)), np.eye(4))
    places = np.column_stack([(RNG.random((1000, 2)) - 0.5) * 30.0, np.full(1000, 20.0)])
    with pytest.warns(UserWarning, match="nearly as well in another pose"):
        nbv.deviation(cloud(places, np.tile([0.0, 0.0, 1.0], (1000, 1))), BOX)


def test_what_cannot_be_compared_is_refused(marked, tmp_path):
    points, normals, _ = scanned_box(HEIGHT, count=60)
    scan = cloud(points, normals)
    unmeasured = marked.copy()
    unmeasured.face_attributes["measured"][:] = 0
    units = r"across and the CAD .*units differ.*apply_scale\(0\.001\)"
    for arguments, message in (
        *(((scan, BOX.copy().apply_scale(factor)), units) for factor in (1e-3, 1.0 / 25.4, 1e3)),
        ((scan, tmp_path / "gone.stl"), "no mesh file at"),
        ((scan, trimesh.Trimesh()), "has no faces"),
        (
            (scan, trimesh.Trimesh(np.ones((3, 3)), [[0, 1, 2]], process=False)),
            "all 1 faces of the mesh have zero area",
        ),
        ((cloud(points[:3], normals[:3]), BOX), "the scan has 3 points: give at least 10"),
        ((unmeasured, BOX), "none of the 192 faces of the scan was measured"),
        ((scan, BOX, [[1.0, 0.0], [0.0, 1.0]]), r"the pose has shape \(2, 2\)"),
        ((scan, BOX, np.diag([2.0, 2.0, 2.0, 1.0])), "no rigid motion"),
    ):
        with pytest.raises(InputError, match=message):
            nbv.deviation(*arguments)
    result = nbv.deviation(scan, BOX, register=False)
    for call, message in (
        (lambda: result.percentile(101.0), "101.0 percent"),
        (lambda: result.worst(0), "places is 0"),
        (lambda: result.worst(min_distance=-1.0), "-1.0 apart"),
        (lambda: result.figure(scale=0.0), "scale is 0.0"),
        (lambda: result.figure(limit=-1.0), "end at -1.0"),
        (lambda: result.figure(up="w"), "up is 'w'"),
    ):
        with pytest.raises(InputError, match=message):
            call()


def test_the_figure_shows_the_flaw_in_the_colour_of_its_sign_and_numbers_it(tmp_path, monkeypatch):
    monkeypatch.setattr("jaxnbv.viz.deviation_figure._SIZE", 200)
    points, normals, _ = scanned_box(-HEIGHT)
    figure = nbv.deviation(cloud(points / 1e3, normals), BOX.copy().apply_scale(1e-3), register=False).figure("mm", 1e3)
    first, second, bar = figure.axes
    assert bar.get_ylabel() == "deviation (mm)"
    assert bar.get_ylim() == pytest.approx((-2.0, 2.0), abs=0.2)
    texts = " ".join(text.get_text() for text in figure.texts)
    assert "1:  −1.9" in texts or "1:  −1.8" in texts
    assert any(f"{share} % of the CAD not scanned" in texts for share in (49, 50, 51, 52))
    assert [text.get_text() for axes in (first, second) for text in axes.texts].count("1") >= 1
    image = np.asarray(first.images[0].get_array())
    clear, (red, _, blue) = image[..., 3] > 0.9, np.moveaxis(image[..., :3], -1, 0)
    assert np.sum(clear & (blue > red + 0.3)) > 200
    assert np.sum(clear & (red > blue + 0.3)) == 0
    figure.savefig(tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 10_000
