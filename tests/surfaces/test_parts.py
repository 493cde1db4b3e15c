"""Parts at true size: their bank, misfits of rays, identity and pose."""

import dataclasses
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

import jaxnbv as nbv
from jaxnbv.scanning.sdf import Cuboid, Cylinder, Difference, Sphere, Translated, Union
from jaxnbv.surfaces.part_evidence import Rays, evidence
from jaxnbv.surfaces.part_hypotheses import NONE, PartHypotheses, identify
from jaxnbv.surfaces.part_pose import object_pose, surface_error, symmetries
from jaxnbv.surfaces.part_search import placeholder_hypotheses, search_parts
from jaxnbv.surfaces.placement import FreeRotation, Placement
from jaxnbv.surfaces.registration import FitTargets, Hypotheses
from jaxnbv.surfaces.shape_bank import Shape

CAMERA = nbv.Camera(height=40, width=40, fov=1.0)
GRID = nbv.Grid(48)


def lamp(arm):
    """Two boxes and a ball, without symmetry."""
    boxes = Union(
        Cuboid(np.array([0.9, 0.3, 0.4])), Translated(Cuboid(np.array([0.2, arm, 0.25])), np.array([0.6, 0.5, 0.1]))
    )
    return Union(boxes, Translated(Sphere(0.3), np.array([-0.6, 0.2, 0.3])))


ARMS = (0.4, 0.65, 0.9)
BANK = nbv.ShapeBank.of([lamp(arm) for arm in ARMS], [f"arm {arm}" for arm in ARMS], is_true_size=True)
TURN, SHIFT = Rotation.from_rotvec([0.4, -1.1, 0.7]), np.array([0.1, -0.15, 0.05])


def observations_of(surface, positions, sampler=None, noise=0.005):
    sampler = sampler or nbv.SurfaceSampler(grid=GRID)
    planner = nbv.Planner(nbv.Coverage(), camera=CAMERA, sampler=sampler, capacity=512, max_views=4)
    observations = None
    for index, position in enumerate(positions):
        pose = nbv.look_at(position)
        scan = nbv.SensorNoise(noise, noise)(nbv.scan(surface, CAMERA, pose), jax.random.key(index))
        observations = planner.init(pose, scan) if observations is None else planner.observe(observations, pose, scan)
    return observations


def placed(indices, placements, misfits=None):
    misfits = jnp.zeros(len(indices)) if misfits is None else jnp.asarray(misfits)
    rows = jax.tree.map(lambda *leaves: jnp.stack(leaves), *placements)
    return Hypotheses(jnp.asarray(indices), rows, misfits, jnp.ones(len(indices), bool))


def still(shift=(0.0, 0.0, 0.0)):
    return Placement(jnp.eye(3), jnp.asarray(shift, jnp.float32), jnp.ones(3))


@pytest.fixture(scope="module")
def meshes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("parts")
    trimesh.creation.box((40.0, 60.0, 100.0)).apply_translation((5.0, -20.0, 300.0)).export(folder / "box.stl")
    trimesh.creation.icosphere(2, 25.0).export(folder / "ball.ply")
    return folder


def test_a_bank_keeps_true_sizes(meshes):
    """Vertices of a mesh in millimetres lie on its shape in metres, and in a scene at the scene's scale."""
    bank = nbv.ShapeBank.from_meshes(meshes, resolution=24, progress=False, scale="mm")
    assert bank.names == ("ball", "box")
    assert bank.is_true_size
    assert np.asarray(bank.extremes[1]).max(axis=0) == pytest.approx([0.02, 0.03, 0.05], abs=1e-6)
    for scaled, factor in ((bank, 1.0), (bank.in_scene(nbv.Frame(scale=8.0)), 8.0)):
        mesh = trimesh.load(meshes / "box.stl")
        on_faces = mesh.triangles_center * 1.0
        own = np.asarray(scaled.from_mesh[1]) @ np.c_[on_faces, np.ones(len(on_faces))].T
        assert own[:3].max(axis=1) == pytest.approx(factor * np.array([0.02, 0.03, 0.05]), rel=1e-5)
        assert np.asarray(scaled.shape(jnp.asarray(1)).solid(jnp.asarray(own[:3].T))) == pytest.approx(
            0.0, abs=2e-3 * factor
        )
    assert bank.select([1]).is_true_size
    without = nbv.ShapeBank.of([Sphere(0.5)])
    assert without.in_scene(nbv.Frame(scale=8.0)) is without


def bracket(hole, middle=(0.0, 0.0, 0.0)):
    """A block of 40 x 60 x 100 with a pocket of depth `hole` at one end, without mirror symmetry."""
    block = trimesh.creation.box((40.0, 60.0, 100.0))
    cut = trimesh.creation.box((20.0, 30.0, hole)).apply_translation((6.0, 5.0, 50.0 - hole / 2.0 + 1e-3))
    corners = np.concatenate([block.vertices, cut.vertices])
    # A pocket is open: the lid of the cut lies in the face of the block.
    faces = np.concatenate([block.faces, len(block.vertices) + cut.faces[:, ::-1]])
    return trimesh.Trimesh(corners, faces).apply_translation(middle)


def test_equal_parts_warn():
    """A part that is moved or drawn along other axes is the same. A smaller one, one with a deeper hole and a mirror
    image are not."""
    own = bracket(30.0)
    turned = own.copy().apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (0, 1, 0), (7.0, 1.0, 2.0)))
    mirrored = own.copy()
    mirrored.apply_transform(np.diag([1.0, -1.0, 1.0, 1.0]))
    parts = [own, turned, bracket(30.0, (5.0, 5.0, 5.0)), bracket(45.0), own.copy().apply_scale(0.96), mirrored]
    names = ["own", "turned", "moved", "deeper", "smaller", "mirrored"]
    with pytest.warns(UserWarning, match="these parts are the same") as warning_list:
        nbv.ShapeBank.from_meshes(parts, names=names, resolution=48, progress=False, scale="mm")
    (warning,) = warning_list
    assert re.findall(r"(\w+) and (\w+) \(up to", str(warning.message)) == [
        ("own", "turned"),
        ("own", "moved"),
        ("turned", "moved"),
    ]


@pytest.mark.parametrize("scale", ["yard", 0.0, -1.0, float("nan")])
def test_other_units_are_refused(meshes, scale):
    with pytest.raises(nbv.InputError, match="unit"):
        nbv.ShapeBank.from_meshes(meshes, resolution=24, progress=False, scale=scale)


def test_misfit_of_rays_to_a_ball():
    """Hits of a ball lie 0.04 from the surface of a larger ball, and pass through it by as much, in closed form."""
    observations = observations_of(nbv.SDFSurface(Sphere(0.8)), [(0.0, 0.0, 3.0)], noise=0.0)
    rays = Rays.of(observations, nbv.Box())
    bank = nbv.ShapeBank.of([Sphere(0.8), Sphere(0.84), Sphere(0.76)], is_true_size=True)
    misfits, none = evidence(bank, placed([0, 1, 2], [still()] * 3), rays)
    met = float(jnp.sum(rays.weight * rays.is_object))
    each = float(np.log1p(0.04**2 / (2 * 0.03**2)))
    assert met > 20
    assert float(misfits[0]) == pytest.approx(0.0, abs=1e-3 * met)
    # The smaller ball only misses points. Rays also pass through the larger ball, up to tau before the hit.
    assert float(misfits[2]) == pytest.approx(each * met, rel=0.02)
    assert each * met < float(misfits[1]) < 2.0 * each * met + 0.1 * met
    assert float(none) == pytest.approx(0.25 * met, rel=0.01)


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_errors_of_points_are_those_of_the_sensor(noise):
    """tau is two standard deviations of the points along the rays, to an eighth (the quartile of 1,500 has an accuracy
    of 4 %). Noise alone makes a ball no other object."""
    pose = nbv.look_at((0.0, 0.0, 3.0))
    camera = nbv.Camera(height=80, width=80, fov=1.0)
    scan = nbv.scan(nbv.SDFSurface(Sphere(0.8)), camera, pose)
    along = noise * jax.random.normal(jax.random.key(0), scan.sight.shape)
    directions = (scan.points - pose.position) / jnp.linalg.norm(scan.points - pose.position, axis=-1, keepdims=True)
    points = jnp.where(scan.mask[:, None], scan.points + along[:, None] * directions, 0.0)
    scan = dataclasses.replace(scan, points=points, sight=scan.sight + jnp.where(scan.mask, along, 0.0))
    planner = nbv.Planner(nbv.Coverage(), camera=camera, sampler=nbv.SurfaceSampler(grid=GRID), capacity=512)
    rays = Rays.of(planner.init(pose, scan), nbv.Box())
    assert float(rays.tau) == pytest.approx(max(0.03, 2.0 * noise), rel=0.12)
    bank = nbv.ShapeBank.of([Sphere(0.8), Sphere(1.1)], is_true_size=True)
    (right, wrong), none = evidence(bank, placed([0, 1], [still()] * 2), rays)
    assert float(right) < float(none) < float(wrong)


def test_silence_is_no_evidence_against_a_part():
    """Rays without a return cost nothing where no view has seen space to be empty."""
    observations = observations_of(nbv.SDFSurface(Sphere(0.8)), [(0.0, 0.0, 3.0)], noise=0.0)
    beside = nbv.ShapeBank.of([Translated(Sphere(0.3), np.array([0.0, 1.0, 0.0]))], is_true_size=True)
    unknown = dataclasses.replace(observations, empty_nodes=jnp.zeros_like(observations.empty_nodes))
    (silent,), _ = evidence(beside, placed([0], [still()]), Rays.of(unknown, nbv.Box()))
    (seen,), _ = evidence(beside, placed([0], [still()]), Rays.of(observations, nbv.Box()))
    rays = Rays.of(observations, nbv.Box())
    assert float(silent) < float(seen)
    assert float(seen) - float(silent) > 5.0 * float(rays.weight.min())


@pytest.fixture(scope="module")
def seen():
    """The second lamp from two sides, and the hypotheses after each view."""
    turned = lamp(ARMS[1]).rotate(TURN.as_rotvec(), float(np.linalg.norm(TURN.as_rotvec()))).translate(SHIFT)
    sampler = nbv.SurfaceSampler(grid=GRID).with_bank(BANK, nbv.surfaces.FreeRotation())
    surface = nbv.SDFSurface(turned)
    return [
        observations_of(surface, positions, sampler)
        for positions in ([(0.5, 1.0, 3.4)], [(0.5, 1.0, 3.4), (-2.2, 1.5, -2.2)])
    ]


def test_a_part_is_named_and_placed(seen):
    for observations in seen:
        hypotheses = observations.hypotheses
        names = hypotheses.names()
        assert next(iter(names)) == "arm 0.65"
        assert sum(names.values()) == pytest.approx(1.0, abs=1e-5)
    assert names["arm 0.65"] > 0.9
    pose = object_pose(hypotheses, seen[1], nbv.Frame())
    assert pose.name == "arm 0.65"
    off = Rotation.from_matrix(pose.matrix[:3, :3] @ TURN.as_matrix().T).magnitude()
    assert np.degrees(off) < 2.0
    assert pose.matrix[:3, 3] == pytest.approx(SHIFT, abs=0.02)
    assert len(pose.alternatives) == 1
    # The stated errors are of the size of the true errors.
    assert 0.0005 < np.sqrt(np.diag(pose.covariance)).min() < np.sqrt(np.diag(pose.covariance)).max() < 0.05
    error = surface_error(hypotheses, seen[1])
    assert error < 0.03
    # The order of the hypotheses says nothing.
    turned = jax.tree.map(lambda rows: rows[::-1], (hypotheses.placed, hypotheses.weights[:-1]))
    weights = jnp.append(turned[1], hypotheses.weights[-1])
    backwards = dataclasses.replace(hypotheses, placed=turned[0], weights=weights)
    assert surface_error(backwards, seen[1]) == pytest.approx(error, rel=1e-5)


def test_misfits_are_comparable_with_none_of_these(seen):
    """Weights are proportional to exp(-misfit), with and without rays."""
    bare = dataclasses.replace(seen[0], looks=None)
    bare_hypotheses = identify(BANK, nbv.surfaces.FreeRotation(), nbv.Box(), bare, None)
    sampler = nbv.SurfaceSampler(nbv.GeometricSPSR(truncation=8), GRID).with_bank(BANK, nbv.surfaces.FreeRotation())
    for observations in (seen[0], dataclasses.replace(seen[0], hypotheses=bare_hypotheses)):
        listed = sampler.posterior(observations).hypotheses
        misfits = np.array([one.misfit for one in listed])
        energy = np.exp(misfits.min() - misfits)
        assert [one.weight for one in listed] == pytest.approx(energy / energy.sum(), abs=1e-4)


def test_the_pose_is_of_the_world_and_of_the_mesh(seen):
    """In a rotated, shifted and scaled world the same matrix follows by composition."""
    frame = nbv.Frame(scale=5.0, center=(1.0, 2.0, 3.0), up="z")
    in_scene = object_pose(seen[1].hypotheses, seen[1], nbv.Frame())
    in_world = object_pose(seen[1].hypotheses, seen[1], frame)
    corner = np.array([0.9, 0.3, 0.4])
    point = in_scene.matrix[:3, :3] @ corner + in_scene.matrix[:3, 3]
    assert in_world.matrix[:3, :3] @ (corner / 5.0) + in_world.matrix[:3, 3] == pytest.approx(
        np.asarray(frame.to_world(point)), abs=0.2
    )
    assert np.linalg.det(in_world.matrix[:3, :3]) == pytest.approx(1.0)
    error = np.sqrt(np.trace(in_world.covariance[3:, 3:])) * 5.0
    assert error == pytest.approx(np.sqrt(np.trace(in_scene.covariance[3:, 3:])), rel=1e-4)


def test_hypotheses_are_kept_and_the_same_by_the_same_views(seen):
    again = identify(BANK, nbv.surfaces.FreeRotation(), nbv.Box(), seen[0], None)
    assert eqx.tree_equal(again.placed.shape, seen[0].hypotheses.placed.shape)
    carried = identify(BANK, nbv.surfaces.FreeRotation(), nbv.Box(), seen[0], again)
    best = float(carried.placed.misfit.min())
    assert best <= float(again.placed.misfit.min()) * 1.1 + 1.0


def housing(x, z, radius):
    """A block with a pocket that holds a pin."""
    block = Difference(
        Cuboid(np.array([0.75, 1.25, 0.55])),
        Translated(Cuboid(np.array([0.42, 0.7, 0.3])), np.array([0.15, 0.75, 0.0])),
    )
    return Union(block, Translated(Cylinder(radius, 0.25), np.array([0.15 + x, 0.25, z])))


def test_look_alikes_share_a_placement():
    """From below no view shows the pin. A part without a placement of its own gets the true placement of the other."""
    pins = [(-0.25, 0.0, 0.12), (0.25, 0.0, 0.12), (0.0, 0.15, 0.12), (0.0, -0.15, 0.12), (0.0, 0.0, 0.22)]
    bank, box = nbv.ShapeBank.of([housing(*pin) for pin in pins], is_true_size=True), nbv.Box.cube(2.9)
    turn = TURN.as_matrix().astype(np.float32)
    sampler = nbv.SurfaceSampler(grid=GRID, carving=nbv.Carving(nbv.Box.cube(3.2)))
    surface = nbv.SDFSurface(nbv.sdf.Rotated(housing(*pins[3]), turn))
    observations = observations_of(surface, [TURN.apply([0.4, -4.0, 0.9])], sampler)
    true = Placement(jnp.asarray(turn), jnp.zeros(3), jnp.ones(3))
    carried_over = Hypotheses(jnp.asarray(0), true, jnp.asarray(0.0), jnp.asarray(True))
    before = jax.tree.map(lambda rows, row: rows.at[0].set(row), placeholder_hypotheses(jnp.float32), carried_over)
    seen, rays = FitTargets.of(observations), Rays.of(observations, box)
    for carried, all_parts in ((before, set(range(5))), (placeholder_hypotheses(jnp.float32), set())):
        placements = search_parts(bank, FreeRotation(), box, seen, rays, carried, 4)
        off = (TURN.inv() * Rotation.from_matrix(placements.placement.rotation)).magnitude()
        there = np.asarray(placements.is_distinct) & (off < np.radians(3.0))
        assert set(np.asarray(placements.shape)[there]) == all_parts


def test_none_of_these():
    """A ball is no lamp."""
    sampler = nbv.SurfaceSampler(grid=GRID).with_bank(BANK, nbv.surfaces.FreeRotation())
    ball = nbv.SDFSurface(Sphere(1.1))
    observations = observations_of(ball, [(0.5, 1.0, 3.4), (-2.2, 1.5, -2.2)], sampler)
    assert observations.hypotheses.names()[NONE] > 0.95


@pytest.mark.parametrize(
    ("solid", "number"),
    [
        (Cuboid(np.ones(3)), 24),
        (Cuboid(np.array([1.0, 0.8, 0.6])), 4),
        (Cuboid(np.array([1.0, 0.6, 0.6])), 8),
        (Cylinder(0.5, 1.0), 144),
        (lamp(0.5), 1),
    ],
    ids=["cube", "brick", "square bar", "cylinder", "lamp"],
)
def test_symmetries(solid, number):
    """The rotation groups of these solids. A cylinder has steps of five degrees, either way up."""
    directions = np.asarray(Rotation.random(64, random_state=0).as_matrix())[:, :, 0]
    turns = symmetries(Shape(solid, jnp.asarray(1.5 * directions)))
    assert len(turns) == number
    assert turns[0] == pytest.approx(np.eye(3))


def test_covariance_of_a_ball():
    """Nothing determines the rotation of a ball. Its position is determined by the points, each along its normal."""
    observations = observations_of(nbv.SDFSurface(Sphere(0.8)), [(0.0, 0.0, 3.0), (0.0, 0.0, -3.0)], noise=0.02)
    bank = nbv.ShapeBank.of([Sphere(0.8)], is_true_size=True)
    hypotheses = PartHypotheses(bank, placed([0], [still()]), jnp.array([1.0, 0.0]), *2 * [jnp.asarray(0.03)])
    covariance = object_pose(hypotheses, observations, nbv.Frame()).covariance
    assert np.diag(covariance)[:3] == pytest.approx(np.pi**2 / 3.0, rel=1e-3)
    # Least squares by the normals of the points. Farthest point sampling prefers points with large errors.
    points = np.asarray(FitTargets.of(observations).points)
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    expected = np.linalg.inv(normals.T @ normals / 0.02**2)
    assert np.diag(covariance)[3:] == pytest.approx(np.diag(expected), rel=0.6)
