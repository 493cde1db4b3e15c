"""Banks of known shapes, from solids and from mesh files."""

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import jaxnbv as nbv
from jaxnbv.scanning.sdf import Sphere, solid_of_mesh
from jaxnbv.surfaces import mesh_shapes


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """A cache for this test."""
    monkeypatch.setattr(mesh_shapes.platformdirs, "user_cache_path", lambda name: tmp_path / "cache")
    return tmp_path / "cache" / "shapes"


def nodes(count=200, reach=1.2):
    return np.random.default_rng(0).uniform(-reach, reach, (count, 3)).astype(np.float32)


def ball(path, inverted=False):
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.7)
    if inverted:
        mesh.invert()
    mesh.export(path)
    return path


def bank_of(*files, **options):
    return nbv.ShapeBank.from_meshes(list(files), progress=False, **options)


def test_a_bank_gives_back_its_shapes_and_names():
    bank = nbv.ShapeBank.of([Sphere(0.5), Sphere(0.8), Sphere(1.0)], ["small", "größer", "x" * 100])
    assert len(bank) == 3
    assert bank.names == ("small", "größer", "x" * 64)
    chosen = bank.select([2, 0])
    assert chosen.names == ("x" * 64, "small")
    np.testing.assert_allclose(chosen.shape(jnp.asarray(0)).solid(jnp.zeros((1, 3))), [-1.0])
    assert len(bank.select([])) == 0


@pytest.mark.parametrize("inverted", [False, True])
def test_a_closed_mesh_has_the_distances_of_its_solid(tmp_path, inverted):
    """A ball of radius 1.25 in scene units. A mesh with inverted winding is the same solid."""
    bank = bank_of(ball(tmp_path / "ball.ply", inverted))
    x = nodes()
    distance = bank.shape(jnp.asarray(0)).solid(x)
    np.testing.assert_allclose(distance, np.linalg.norm(x, axis=1) - 1.25, atol=0.02)
    assert bank.names == ("ball",)
    assert not bank.is_true_size
    np.testing.assert_allclose(np.linalg.norm(bank.extremes[0], axis=1), 1.25, atol=0.01)


def test_a_sheet_is_as_thick_as_asked(tmp_path):
    mesh = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    mesh.export(tmp_path / "sheet.ply")
    solid = bank_of(tmp_path / "sheet.ply", sheet=0.2).shape(jnp.asarray(0)).solid
    across = np.stack([np.zeros(5), np.zeros(5), np.linspace(-0.3, 0.3, 5)], axis=1)
    np.testing.assert_allclose(solid(jnp.asarray(across, jnp.float32)), np.abs(across[:, 2]) - 0.1, atol=0.03)


def test_a_closed_solid_is_no_thicker_for_the_sheets():
    mesh = trimesh.creation.box((1.0, 0.8, 0.6))
    plain, thick = (solid_of_mesh(mesh.vertices, mesh.faces, 16, sheet=sheet) for sheet in (0.0, 0.3))
    np.testing.assert_array_equal(plain.values, thick.values)


def test_meshes_of_a_folder_are_named_by_their_place(tmp_path):
    (tmp_path / "a" / "b").mkdir(parents=True)
    ball(tmp_path / "a" / "b" / "one.obj")
    ball(tmp_path / "two.stl")
    (tmp_path / "notes.txt").write_text("no mesh")
    assert nbv.ShapeBank.from_meshes(tmp_path, resolution=16, progress=False).names == ("a/b/one", "two")


def test_what_cannot_be_used_is_named_and_left_out(tmp_path):
    (tmp_path / "broken.ply").write_bytes(b"ply\nnothing")
    with pytest.warns(UserWarning, match=r"broken\.ply is left out of the bank: .*cannot read"):
        bank = bank_of(ball(tmp_path / "ball.ply"), tmp_path / "broken.ply", resolution=16, names=["good", "bad"])
    assert bank.names == ("good",)
    with pytest.warns(UserWarning, match="left out"), pytest.raises(nbv.InputError, match="none of the 1 meshes"):
        bank_of(tmp_path / "broken.ply")


def test_stored_shapes_are_reused_and_changed_meshes_and_damaged_files_recomputed(tmp_path, cache, monkeypatch):
    file = ball(tmp_path / "ball.ply")
    first = bank_of(file, resolution=16)
    with monkeypatch.context() as patch:
        patch.setattr(mesh_shapes, "load_mesh", lambda path: pytest.fail("it was read anew"))
        again = bank_of(file, resolution=16)
    (cached,) = cache.iterdir()
    cached.write_bytes(cached.read_bytes()[:100])
    for other in (again, bank_of(file, resolution=16)):
        np.testing.assert_array_equal(first.shapes.solid.values, other.shapes.solid.values)
    trimesh.creation.box((1.0, 0.4, 0.4)).export(file)
    changed = bank_of(file, resolution=16)
    assert not np.array_equal(first.shapes.solid.values, changed.shapes.solid.values)


def test_a_full_disk_costs_no_shape(tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(mesh_shapes.np, "savez_compressed", refuse)
    with pytest.warns(UserWarning, match="cannot be stored in the cache .No space left"):
        assert len(bank_of(ball(tmp_path / "ball.ply"), resolution=16)) == 1
