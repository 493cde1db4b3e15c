"""Points and surfaces as files, for a ball of 10 cm in a world in metres."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from small_session import BOX, FIRST, POSES, planner_of, session_of, shot

import jaxnbv as nbv
from jaxnbv.checks import InputError
from jaxnbv.surfaces.known_shapes import KnownShapesPosterior
from jaxnbv.surfaces.placement import Placement
from jaxnbv.surfaces.registration import Hypotheses
from jaxnbv.viz import export
from jaxnbv.viz.export import missing_regions, save_cloud, save_mesh, scanned_cloud, surface_mesh

CENTER, EYES = np.array([0.3, 0.2, 0.101]), np.stack([FIRST[:3, 3], POSES[2][:3, 3]])


@pytest.fixture(scope="module")
def episode():
    session = session_of(planner=planner_of())
    for matrix in (FIRST, POSES[2]):
        session.add(shot(matrix), matrix, depth_scale=1e-3)
    return session.episode


def off(points):
    return np.abs(np.linalg.norm(points - CENTER, axis=1) - 0.1)


def test_the_cloud_has_all_points_of_the_scans(episode):
    points, normals = scanned_cloud(episode).to_numpy()
    assert len(points) == sum(int(view.scan.count) for view in episode.views) > 400
    assert off(points).max() < 0.005
    assert np.median(np.sum(normals * (points - CENTER), axis=1)) / 0.1 > 0.95


def test_the_surface_is_marked_where_it_was_measured(episode):
    mesh = surface_mesh(episode)
    cell = float(episode.frame.length_to_world(episode.planner.sampler.grid.spacing))
    measured = mesh.face_attributes["measured"] == 1
    assert 0 < measured.sum() < len(measured)
    centers = mesh.triangles_center
    assert off(centers[measured]).max() < 1.5 * cell
    # The far side of the ball is hidden from both cameras, and was not measured.
    hidden = ((centers - CENTER) @ (EYES - CENTER).T < -0.02).all(axis=1)
    assert hidden.any()
    assert not measured[hidden].any()
    deviation = mesh.vertex_attributes["deviation"]
    assert deviation[mesh.faces[hidden]].mean() > 3.0 * deviation[mesh.faces[measured]].mean()
    alone = surface_mesh(episode, imagined=False)
    assert len(alone.faces) == measured.sum()
    assert alone.face_attributes["measured"].all()


def test_of_known_shapes_the_one_in_the_pictures_is_exported(episode, monkeypatch):
    """The likelier of two balls, or the surface of no known shape if "none of these" is nearly certain."""
    base = nbv.GeometricSPSR(0.05, truncation=8)
    plain = nbv.ScreenedSPSR(base, (nbv.surfaces.OnSurface(),)).condition(
        nbv.PointCloud.from_arrays(EYES, np.eye(3)[:2])
    )
    bank = nbv.ShapeBank.of([nbv.sdf.Sphere(0.8), nbv.sdf.Sphere(0.5)], ["ball 1", "pea 1"])
    places = Placement(jnp.tile(jnp.eye(3), (2, 1, 1)), jnp.zeros((2, 3)), jnp.ones((2, 3)))
    fits, posteriors = Hypotheses(jnp.arange(2), places, jnp.zeros(2), jnp.ones(2, bool)), []
    monkeypatch.setattr(export, "mean_surface", lambda sampler, inputs: posteriors.append(inputs.posterior))
    for weights in ([0.2, 0.3, 0.5], [0.02, 0.03, 0.95]):
        zero, model = jnp.zeros(()), nbv.surfaces.KnownShapes(bank)
        known = KnownShapesPosterior(zero, model, fits, jnp.array(weights), zero, plain, plain)
        monkeypatch.setattr(nbv.SurfaceSampler, "posterior", lambda self, observations, known=known: known)
        with pytest.raises(InputError, match="holds no surface"):
            surface_mesh(episode)
    np.testing.assert_array_equal(posteriors[0].weights, [0.0, 1.0, 0.0])
    assert posteriors[1] is plain


def test_what_is_missing_is_the_far_side_in_metres(episode):
    """The part of the ball that no camera sees is one region, which faces away from both."""
    regions = missing_regions(episode, smallest=1e-3)
    distances = np.linalg.norm(EYES - CENTER, axis=1)
    eyes = (EYES - CENTER) / distances[:, None]
    largest = regions[0]
    assert largest.normal @ eyes.sum(axis=0) < 0
    assert np.linalg.norm(largest.normal) == pytest.approx(1.0)
    # By points spread evenly over the ball. A camera at distance d sees points whose cosine to it is above r / d.
    points = np.random.default_rng(0).normal(size=(20_000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    hidden = (points @ eyes.T < 0.1 / distances).all(axis=1)
    area = hidden.mean() * 4 * np.pi * 0.1**2
    # Surface within a cell of the border may count as missing or not.
    assert sum(region.area for region in regions) == pytest.approx(area, rel=0.35)
    assert largest.center @ points[hidden].mean(axis=0) > CENTER @ points[hidden].mean(axis=0)
    assert all(a.area >= b.area > 1e-3 for a, b in itertools.pairwise([*regions, regions[-1]]))
    assert largest.radius < 0.2


def test_files_hold_world_units(episode, tmp_path):
    for kind in ("ply", "xyz"):
        vertices = np.asarray(trimesh.load(save_cloud(episode, tmp_path / f"cloud.{kind}")).vertices)
        np.testing.assert_allclose(vertices, scanned_cloud(episode).to_numpy()[0], atol=1e-4)
    for kind in ("ply", "obj", "stl", "glb"):
        mesh = trimesh.load(save_mesh(episode, tmp_path / f"mesh.{kind}"), force="mesh")
        assert len(mesh.faces) > 100
        assert np.all((mesh.bounds - BOX) * [[1.0], [-1.0]] > -0.02)
    raw = trimesh.load(tmp_path / "mesh.ply", process=False).metadata["_ply_raw"]
    assert "deviation" in raw["vertex"]["properties"]
    assert "measured" in raw["face"]["properties"]


def test_what_cannot_be_written_is_refused(episode, tmp_path):
    formats = r"does not say a format: end it with one of \.ply, \.obj, \.glb, \.stl, \.off"
    with pytest.raises(InputError, match=formats):
        save_mesh(episode, tmp_path / "mesh.step")
    with pytest.raises(InputError, match="no view yet"):
        scanned_cloud(nbv.Episode(episode.planner, None, None, episode.first, episode.key))
