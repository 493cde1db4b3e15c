"""The shipped banks of known shapes."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from make_banks import write_bank
from scipy.spatial.transform import Rotation

import jaxnbv as nbv
from jaxnbv.cli.registry import BANKS as LISTED
from jaxnbv.scanning import sdf
from jaxnbv.studies.scenes import Split, pyramid_scene, truck_scene
from jaxnbv.studies.scenes.banks import RECIPES
from jaxnbv.surfaces.shipped_banks import SHIPPED_BANKS, bank_poses, read_bank, shape_bank

X = np.random.default_rng(0).uniform(-1.3, 1.3, (100, 3)).astype(np.float32)

distances = eqx.filter_jit(lambda solid, x: solid(x))


@pytest.mark.parametrize("name", SHIPPED_BANKS)
def test_a_bank_holds_the_objects_of_the_training_split_with_their_extremes(name):
    bank = shape_bank(name)
    if name in RECIPES:
        number, kinds, shape = RECIPES[name]
        assert len(bank) == number
        for index in (0, 1, number - 1):
            stored = distances(bank.shape(jnp.asarray(index)).solid, X)
            # Up to the sixteen stored bits.
            np.testing.assert_allclose(stored, distances(shape(index), X), atol=4e-3)
            assert bank.names[index] == f"{kinds[index % len(kinds)]} {index}"
    picked = jnp.arange(0, len(bank), max(1, len(bank) // 8))
    some, points = jax.tree.map(lambda rows: rows[picked], bank.shapes)
    away = eqx.filter_jit(jax.vmap(lambda solid, x: solid(x)))(some, points)
    # Up to a voxel for meshes, and otherwise up to sixteen bits and bounds that fall short of the distance.
    assert np.quantile(np.abs(away), 0.9) < 0.05
    # Shapes are stored with a length of 2.5, so that nothing is farther out than their extremes.
    np.testing.assert_allclose(np.ptp(np.asarray(bank.extremes), axis=1).max(axis=1), 2.5, atol=0.08)


def test_real_shapes_are_named_by_their_class_and_stand_upright():
    bank = shape_bank("household-real")
    assert {"chair", "table", "sofa"} <= {name.split()[0] for name in bank.names}
    np.testing.assert_allclose(np.ptp(np.asarray(bank.extremes), axis=1).max(axis=1), 2.5, atol=0.01)
    assert isinstance(bank_poses("household-real"), nbv.surfaces.Upright)


@pytest.mark.parametrize(("scene", "axis"), [(pyramid_scene, 2), (truck_scene, 1)])
def test_scenes_of_a_split_are_those_of_the_bank_turned(scene, axis):
    """A scene and its level twin are one object: after rotation, translation and scaling their distances agree."""
    turned, level = scene(Split.TRAIN, 3), scene(Split.TRAIN, 3, is_rotated=False)
    one, other = (np.reshape(thing.solid.rotation, (-1, 3, 3))[0] for thing in (turned, level))
    rotation = one @ other.T
    np.testing.assert_allclose(Rotation.from_matrix(rotation).as_matrix(), rotation, atol=1e-5)
    ends = [np.asarray(nbv.mesh_from_sdf(thing, nbv.Grid(64, 1.4)).vertices) for thing in (turned, level)]
    sides = [np.ptp(points @ frame, axis=0) for points, frame in zip(ends, (rotation, np.eye(3)), strict=True)]
    np.testing.assert_allclose(sides[0] / sides[0].max(), sides[1] / sides[1].max(), atol=0.05)


def test_meshes_are_stored_to_their_quantum(tmp_path):
    mesh = nbv.mesh_from_sdf(sdf.Sphere(1.0), nbv.Grid(40, 1.2))
    solid = sdf.solid_of_mesh(mesh.vertices, mesh.faces, 24, cubic=True)
    bank = nbv.ShapeBank.of([solid, solid], ["a", "b"])
    write_bank(tmp_path / "bank.npz", bank)
    stored = read_bank(tmp_path / "bank.npz", solid)
    assert stored.names == ("a", "b")
    expected = np.clip(bank.shapes.solid.values, -1.016, 1.016)
    np.testing.assert_allclose(stored.shapes.solid.values, expected, atol=0.0041)


def test_the_command_line_lists_the_banks_that_ship_and_another_name_is_refused():
    assert tuple(SHIPPED_BANKS) == LISTED
    with pytest.raises(nbv.InputError, match="no bank of shapes 'chairs': choose from pyramid"):
        shape_bank("chairs")
