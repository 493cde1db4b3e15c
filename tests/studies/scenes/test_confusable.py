"""Sets of similar parts: their distances, the share of directions that tell them apart, and mirror images."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxnbv as nbv
from jaxnbv.studies.scenes.confusable import (
    CONFUSABLE_SETS,
    HIDDEN_CUES,
    PARTS_OF_SET,
    confusable_bank,
    confusable_meshes,
)
from jaxnbv.studies.scenes.framing import Setup
from jaxnbv.studies.scenes.placed_parts import confusable_parts, place_part

COMPUTES = True
# Least distance between the surfaces of two parts in scene units; difference of ranges that tells them apart, far
# beyond the noise of 0.015; and number of pixels with such a difference.
APART, TOLD, PIXELS = 0.04, 0.05, 8
CAMERA, POSES = nbv.Camera(), nbv.SphereCandidates(60, 5.0).poses()

distances = eqx.filter_jit(lambda bank, index, points: bank.shape(index).solid(points))


def distances_of(bank, index, points):
    return np.asarray(distances(bank, jnp.asarray(index), jnp.asarray(points, jnp.float32)))


def ranges_of(mesh):
    """Ranges of a mesh from 60 directions."""
    scans = nbv.scan(mesh, CAMERA, POSES)
    return np.where(scans.mask, scans.sight, 9.0)


@pytest.mark.parametrize("name", CONFUSABLE_SETS)
def test_the_parts_of_a_set_differ_and_look_the_same_from_most_directions(name):
    bank, meshes = confusable_bank(name), confusable_meshes(name)
    assert bank.is_true_size
    assert len(bank) == len(meshes) == len({*bank.names}) == PARTS_OF_SET
    values = np.asarray(bank.solids.values)
    apart = np.abs(values[:, None] - values[None]).max(axis=(2, 3, 4))
    assert apart[~np.eye(PARTS_OF_SET, dtype=bool)].min() > APART
    for index, mesh in enumerate(meshes):
        # The same number for all meshes, so that one program serves all.
        some = mesh.vertices[np.linspace(0, len(mesh.vertices) - 1, 4000).astype(int)]
        assert np.abs(distances_of(bank, index, some)).max() < 0.02
        assert np.abs(mesh.vertices).max() < 1.35
    if name in HIDDEN_CUES:
        ranges = np.stack([ranges_of(mesh) for mesh in meshes])
        pairs = [(a, b) for a in range(PARTS_OF_SET) for b in range(a)]
        shares = [((np.abs(ranges[a] - ranges[b]) > TOLD).sum(axis=-1) >= PIXELS).mean() for a, b in pairs]
        # Each pair is told apart from some directions, but from a fifth of them at most.
        assert 0 < min(shares) <= max(shares) <= 0.2


def test_mirror_images_are_equal_by_no_turn():
    bank, half = confusable_bank("mirror"), PARTS_OF_SET // 2
    points = np.random.default_rng(0).uniform(-1.4, 1.4, (20_000, 3))
    turns = Rotation.create_group("O").as_matrix()
    for index in range(half):
        own = distances_of(bank, index, points)
        np.testing.assert_allclose(distances_of(bank, index + half, points * [-1.0, 1.0, 1.0]), own, atol=1e-5)
        off = [np.abs(distances_of(bank, index + half, points @ turn) - own).max() for turn in turns]
        assert min(off) > 0.1


def test_scenes_take_turns_through_the_sets_and_their_parts_and_fit_every_setup():
    (name, parts, part), (other, *_), (again, _, next_part) = (confusable_parts(index) for index in (0, 1, 10))
    assert name == again != other
    assert part != next_part
    assert parts.bank.names[part].startswith(f"{name} ")
    for setup in Setup:
        placed = place_part(parts, part, setup, jax.random.key(1))
        assert np.ptp(placed.mesh.vertices, axis=0).max() == pytest.approx(2.5)
