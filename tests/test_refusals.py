"""Impossible input is refused where it is given, by an error that names the value and the remedy."""

import math

import numpy as np
import pytest

import jaxnbv as nbv
from jaxnbv.geometry.farthest_points import farthest_point_indices
from jaxnbv.networks.layers import ball_query
from jaxnbv.scanning.metrics import surface_distance
from jaxnbv.scanning.sdf import solid_of_mesh

EYE, NOWHERE, SPHERE = np.eye(4), np.zeros((0, 3)), np.asarray(nbv.geometry.fibonacci_sphere(30), np.float64)
TRIANGLE, FACE, TABLE = np.eye(3), np.array([[0, 1, 2]]), nbv.sdf.HalfSpace([0.0, -0.5, 0.0], [0.0, 1.0, 0.0])
BESIDE = nbv.sdf.Sphere(0.5).translate((1.0, 0.0, 0.0))
BANK = nbv.ShapeBank.of([nbv.sdf.Sphere(0.5)] * 4)
SKEWED = [[100.0, 3.0, 30.0], [0.0, 100.0, 20.0], [0.0, 0.0, 1.0]]
MIRRORED = [[-100.0, 0.0, 30.0], [0.0, 100.0, 20.0], [0.0, 0.0, 1.0]]
TRANSPOSED = [[100.0, 0.0, 0.0], [0.0, 100.0, 0.0], [30.0, 20.0, 1.0]]
OF_ANOTHER = [[100.0, 0.0, 320.0], [0.0, 100.0, 240.0], [0.0, 0.0, 1.0]]


def intrinsics(matrix):
    return nbv.Camera.from_intrinsics(np.array(matrix), 40, 60)


def camera_of_lens(*coefficients):
    return nbv.Camera.from_intrinsics(
        [[500.0, 0, 320.0], [0, 500.0, 240.0], [0, 0, 1.0]], 480, 640, distortion=coefficients
    )


def pose_of(rotation):
    return nbv.Pose(rotation, np.zeros(rotation.shape[:-1]))


def mesh_of(vertices, faces):
    return nbv.TriangleMesh.from_arrays(np.asarray(vertices, float), np.asarray(faces))


GEOMETRY = [
    (lambda: intrinsics(SKEWED), "skew of 3"),
    (lambda: intrinsics(MIRRORED), "positive focal lengths"),
    (lambda: intrinsics(TRANSPOSED), "positive focal lengths"),
    (lambda: intrinsics(OF_ANOTHER), r"\(320.0, 240.0\) lies outside .* 60 x 40"),
    (lambda: nbv.Camera(nearest=2.0, farthest=1.0), "from 2.0 to 1.0"),
    (lambda: nbv.Camera(nearest=-1.0), "from -1.0"),
    (lambda: nbv.Camera(max_incidence=2.0), "angle of incidence is 2.0"),
    (lambda: nbv.Camera(aspect=0.0), "aspect of the pixels is 0.0"),
    *((lambda wrong=wrong: camera_of_lens(*wrong), "k1, k2, p1, p2") for wrong in ((0.1,), (0.1,) * 14, (np.nan,) * 5)),
    (lambda: camera_of_lens(-9.0, 0.0, 0.0, 0.0), "folds the image"),
    (lambda: nbv.Camera(fov=0.0), "field of view is 0.0"),
    (lambda: nbv.Camera(fov=math.pi), "field of view is 3.14"),
    (lambda: nbv.Camera(fov=math.nan), "fov is nan; it must be a finite number"),
    (lambda: nbv.Camera(height=0), "at least one"),
    (lambda: nbv.Camera(width=-1), "at least one"),
    (lambda: nbv.Pose.from_matrix(EYE + np.eye(4, k=-3)), r"last row .* not \(0, 0, 0, 1\)"),
    (lambda: nbv.Pose.from_matrix(np.diag([2.0, 2.0, 2.0, 1.0])), "not a rotation"),
    (lambda: nbv.Pose.from_matrix(EYE, "ros"), "'ros'; give one of opencv, opengl"),
    (lambda: pose_of(np.diag([1.0, 1.0, -1.0])), "not a rotation"),
    (lambda: pose_of(np.diag([1.0, 1.0, 1.1])), "not a rotation"),
    (lambda: pose_of(np.eye(3) + 0.01 * np.eye(3, k=1)), "not a rotation"),
    (lambda: pose_of(np.full((3, 3), np.nan)), "not finite"),
    (lambda: pose_of(np.stack([np.eye(3), np.eye(3), np.zeros((3, 3))])), "not a rotation"),
    (lambda: nbv.look_at((1.0, 2.0, 3.0), (1.0, 2.0, 3.0)), "apart from its target"),
    (lambda: nbv.look_at((np.nan, 0.0, 1.0)), "finite"),
    (lambda: nbv.look_at((0.0, 0.0, 2.0), (np.nan, 0.0, 0.0)), "finite coordinates, got target"),
    (lambda: nbv.look_at((0.0, 0.0, 1e30)), r"distance from its target is a finite number, got position \[0"),
    *((lambda up=up: nbv.look_at((0.0, 0.0, 1.0), up=(0.0, up, 0.0)), "up direction") for up in (0.0, 1e30)),
    (lambda: nbv.geometry.fibonacci_sphere(0), "Fibonacci"),
    (lambda: nbv.geometry.fibonacci_sphere(5, 0.0), "radius"),
    (lambda: nbv.Frame.fit(NOWHERE), "no points"),
    (lambda: nbv.Frame.fit(np.ones((4, 3))), "all 4 points lie at"),
    (lambda: nbv.Frame.fit(np.array([[0.0, 0.0, 0.0], [1.0, np.nan, 0.0]])), "not finite"),
    (lambda: nbv.geometry.estimate_normals(SPHERE[:10], (0, 0, 5.0)), "16 of 10 points"),
    (lambda: nbv.geometry.estimate_normals(SPHERE, (0, 0, 5.0), 2), "three at least"),
    (lambda: nbv.geometry.estimate_normals(SPHERE, (0, 5.0)), r"shape \(2,\)"),
    (lambda: nbv.geometry.estimate_normals(np.where(SPHERE > 0.9, np.nan, SPHERE), (0, 0, 5.0)), "not finite"),
    (lambda: nbv.geometry.estimate_normals(SPHERE, tuple(SPHERE[5])), "where the sensor stands"),
    (lambda: nbv.Box((0.0, 0.0, 0.0), (1.0, 0.0, 1.0)), "has no inside"),
    (lambda: nbv.Box((0.0, math.nan, 0.0), (1.0, 1.0, 1.0)), "each of three sides must be positive and finite"),
    (lambda: nbv.Box((0.0, 0.0, 0.0), (1.0, 1.0, math.inf)), "each of three sides must be positive and finite"),
    (lambda: farthest_point_indices(np.zeros((3, 3), np.float32), np.ones(3, bool), 0), "at least one"),
]
SCANNING = [
    *((lambda margin=margin: nbv.Carving(margin_voxels=margin), r"at least 0\.5|finite") for margin in (0.49, np.nan)),
    (lambda: mesh_of(TRIANGLE, np.zeros((0, 3), int)), "no faces"),
    (lambda: mesh_of(np.where(TRIANGLE > 0, np.nan, 0.0), FACE), "not finite"),
    (lambda: mesh_of(TRIANGLE, [[0, 1, 3]]), "but there are 3"),
    (lambda: mesh_of(TRIANGLE, [[0, 1, 1]]), "zero area"),
    (lambda: nbv.sdf.Sphere(-1.0), "must not be negative"),
    (lambda: nbv.sdf.Sphere(np.nan), "finite"),
    (lambda: nbv.sdf.Cuboid([0.1, 0.2, 0.3], 0.15), "reduce the rounding"),
    (lambda: nbv.sdf.Sphere(1.0).rotate([0, 0, 0], 1.0), "not zero"),
    (lambda: nbv.sdf.Sphere(1.0).rotate([0, 1e-30, 0], 1.0), "not zero"),
    *((lambda by=by: nbv.sdf.Sphere(1.0).scale(by), f"scaled by {by}") for by in (-2.0, 0.0)),
    (lambda: nbv.Obstacles((TABLE,), margin=-1.0), "margin is -1.0"),
    (lambda: nbv.Obstacles(clearance=-0.1), "clearance is -0.1"),
    (lambda: nbv.sdf.HalfSpace([0.0, 0.0, 0.0], [0.0, 0.0, 0.0]), "normal is .*: give a direction"),
    (lambda: solid_of_mesh(TRIANGLE, FACE, resolution=3), "resolution is 3"),
    (lambda: solid_of_mesh(np.zeros((3, 3)), FACE), "all 3 vertices of the mesh lie at"),
    (lambda: solid_of_mesh(TRIANGLE, np.array([[0, 1, 3]])), "faces refer to vertices 0 to 3"),
    (lambda: surface_distance(NOWHERE, SPHERE), "reconstruction has.*no points"),
    (lambda: surface_distance(SPHERE, NOWHERE), "true surface has.*no points"),
    (lambda: surface_distance(SPHERE, np.full((1, 3), np.inf)), "true surface has.*finite"),
]
SEARCH = [
    (lambda: nbv.SphereCandidates(0), "0 candidates"),
    (lambda: nbv.SphereCandidates(10, 0.0), "are 0.0 away"),
    (lambda: nbv.SphereCandidates(10, math.inf), "radius is inf; it must be a finite number"),
    (lambda: nbv.SphereCandidates(10, 2.5, 2.0), "elevation is 2.0 rad"),
    (lambda: nbv.SphereCandidates(10, up=(0.0, 0.0, 0.0)), "must be a direction"),
    (lambda: nbv.SphereCandidates(40).where(lambda pose: False), "none of 40 candidates is allowed"),
    (lambda: nbv.Reach(8, 3.0, 2.0), "are 3.0 to 2.0 away"),
    (lambda: nbv.Reach(8, min_elevation=1.0, max_elevation=0.5), "elevations are 1.0 and 0.5 rad"),
    (lambda: nbv.GivenPoses(nbv.look_at((0.0, 0.0, 2.0))), "give a batch"),
    *((lambda wrong=wrong: nbv.DiscreteSearch(wrong), "give how many") for wrong in ("many", 2.5, None)),
    (lambda: nbv.GradientSearch(dof=2, space=nbv.search.FreePoses()), "both dof=2 and space"),
    (lambda: nbv.GradientSearch(learning_rate=0.0), "learning.rate is 0.0"),
    (lambda: nbv.GradientSearch(learning_rate=np.nan), "learning.rate is nan"),
    (lambda: nbv.GradientSearch(num_starts=0), "num_starts is 0"),
    (lambda: nbv.GradientSearch(iterations=0), "iterations is 0"),
    (lambda: nbv.GradientSearch(num_starts=7, num_candidates=6), "6 candidates for 7 starts"),
    (lambda: nbv.search.SpherePoses(0.0), "radius is 0.0; it must be positive"),
    (lambda: nbv.search.FreePoses(math.nan), "radius is nan"),
    (lambda: nbv.search.ConstrainedPoses(2.0, 2.0), "from 2.0 to 2.0"),
    (lambda: nbv.search.ConstrainedPoses(0.0, 2.0), "from 0.0 to 2.0"),
    (lambda: nbv.search.ConstrainedPoses(off_axis=0.5 * math.pi), "off_axis is 1.57"),
    # The default camera's image ends 15 degrees from its centre. With half the width it ends at about half of that.
    (lambda: nbv.search.ConstrainedPoses().check_camera(nbv.Camera(width=25)), "but the image ends 0.133 rad"),
    (lambda: nbv.NewSurface(0.0), r"size is 0\.0"),
    (lambda: nbv.Planner(nbv.Coverage), "acquisition is .*Coverage.*: give one"),
    (lambda: nbv.Planner("coverage"), "acquisition is .*'coverage'.*: give one"),
]
SURFACES = [
    (lambda: nbv.GeometricSPSR(nu=1.0), "nu is 1.0"),
    (lambda: nbv.GeometricSPSR(lengthscale=np.nan), "lengthscale is nan"),
    (lambda: nbv.GeometricSPSR(variance=0.0), "variance is 0.0"),
    (lambda: nbv.GeometricSPSR(truncation=0), "truncation is 0"),
    (lambda: nbv.GeometricSPSR((0.1, 0.2), 0.3), "as many variances as lengthscales"),
    (lambda: nbv.ScreenedSPSR(values=()), "no values"),
    (lambda: nbv.ScreenedSPSR(level_deviation=0.0), "level_deviation is 0.0"),
    (lambda: nbv.ScreenedSPSR(offset=-1.0), "offset is -1.0"),
    (lambda: nbv.surfaces.OnSurface(0), "number of values is 0"),
    (lambda: nbv.surfaces.EmptySpace(noise=-1.0), "noise of the values is -1.0"),
    (lambda: nbv.surfaces.OutsideBoundary(nbv.Box.cube(4.0)), "coordinate of 2"),
    (lambda: nbv.surfaces.OutsideBoundary(nbv.Box((1.0, 1.0, 1.0), (1.2, 1.2, 1.2))), "must enclose the origin"),
    (lambda: nbv.surfaces.OutsideBoundary(BESIDE), "must enclose the origin, whose distance is 0.5"),
    (
        lambda: nbv.SurfaceSampler(carving=nbv.Carving(BESIDE)).with_bank(BANK, nbv.surfaces.FreeRotation()),
        "must enclose the origin, whose distance is 0.5",
    ),
    (lambda: nbv.surfaces.FreeRotation(scale=(0.0, 1.0)), "the scales are"),
    (lambda: nbv.surfaces.FreeRotation(scale=(2.0, 1.0)), "the scales are"),
    (lambda: nbv.surfaces.Upright((0.0, 0.0, 0.0)), "the vertical is zero"),
    (lambda: nbv.surfaces.Upright(within=4.0), "within 4.0 rad"),
    (lambda: nbv.surfaces.KnownShapes(BANK, num_starts=0), "num_starts is 0"),
    (lambda: nbv.surfaces.KnownShapes(BANK, inverse_temperature=-1.0), "inverse_temperature is -1.0"),
    (lambda: nbv.ShapeBank.of([nbv.sdf.Sphere(1.0), nbv.sdf.Cuboid([1.0, 1.0, 1.0])]), "of 2 kinds, such as numbers"),
    (lambda: nbv.ShapeBank.of([nbv.sdf.Sphere(1.0)], ["a", "b"]), "2 names for 1 solids"),
    (lambda: BANK.select([9]), "the bank has 4 shapes"),
    (lambda: nbv.ShapeBank.from_meshes("nowhere"), "there is no folder"),
    (lambda: nbv.ShapeBank.from_meshes("."), "holds no mesh"),
    (lambda: nbv.ShapeBank.from_meshes([]), "no meshes are named"),
    (lambda: nbv.ShapeBank.from_meshes(["a.ply"], names=["a", "b"]), "2 names for 1 meshes"),
    (lambda: nbv.ShapeBank.from_meshes(["a.ply"], resolution=4), "resolution is 4"),
    (lambda: nbv.ShapeBank.from_meshes(["a.ply"], sheet=0.0), "sheets are 0.0 thick"),
    (lambda: ball_query(np.zeros((3, 3)), np.zeros((3, 3)), np.ones(3, bool), 1.0, 0), "at least one"),
]


@pytest.mark.parametrize(("make", "message"), [*GEOMETRY, *SCANNING, *SEARCH, *SURFACES])
def test_impossible_input_is_refused_by_name(make, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(nbv.InputError, match=message):
        make()
