"""Sets of similar parts: their distances, the share of directions that tell them apart, and mirror images."""

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

# Least distance between the surfaces of two parts in scene units; difference of ranges that tells them apart, far
# beyond the noise of 0.015; and number of pixels with such a difference.
APART, TOLD, PIXELS = 0.04, 0.05, 8
CAMERA, POSES = nbv.Camera(), nbv.SphereCandidates(60, 5.0).poses()


def ranges_of(mesh):
    """Ranges of a mesh from 60 directions."""
    scans = nbv.scan(mesh, CAMERA, POSES)
    return np.where(scans.mask, scans.sight, 9.0)


@pytest.mark.parametrize("name", CONFUSABLE_SETS)
def test_the_parts_of_a_set_differ_and_are_what_their_meshes_are(name):
    bank, meshes = confusable_bank(name), confusable_meshes(name)
    assert bank.is_true_size
    assert len(bank) == len(meshes) == PARTS_OF_SET
    assert len({*bank.names}) == PARTS_OF_SET
    values = np.asarray(bank.solids.values)
    apart = np.abs(values[:, None] - values[None]).max(axis=(2, 3, 4))
    assert apart[~np.eye(PARTS_OF_SET, dtype=bool)].min() > APART
    for index, mesh in enumerate(meshes):
        off = bank.shape(jnp.asarray(index)).solid(jnp.asarray(mesh.vertices[::7], jnp.float32))
        assert np.abs(np.asarray(off)).max() < 0.02
        assert np.abs(mesh.vertices).max() < 1.35


@pytest.mark.parametrize("name", HIDDEN_CUES)
def test_parts_with_a_hidden_cue_look_the_same_from_most_directions(name):
    ranges = np.stack([ranges_of(mesh) for mesh in confusable_meshes(name)])
    shares = [
        ((np.abs(ranges[a] - ranges[b]) > TOLD).sum(axis=-1) >= PIXELS).mean()
        for a in range(PARTS_OF_SET)
        for b in range(a)
    ]
    # Each pair is told apart from some directions, but from a fifth of them at most.
    assert 0 < min(shares) <= max(shares) <= 0.2


def test_mirror_images_are_equal_by_no_turn():
    bank = confusable_bank("mirror")
    half = PARTS_OF_SET // 2
    points = np.random.default_rng(0).uniform(-1.4, 1.4, (20_000, 3)).astype(np.float32)
    turns = Rotation.create_group("O").as_matrix().astype(np.float32)
    for index in range(half):
        one, image = (bank.shape(jnp.asarray(row)).solid for row in (index, index + half))
        reflected = np.asarray(image(jnp.asarray(points * [-1.0, 1.0, 1.0], jnp.float32)))
        own = np.asarray(one(jnp.asarray(points)))
        np.testing.assert_allclose(reflected, own, atol=1e-5)
        off = [np.abs(np.asarray(image(jnp.asarray(points @ turn))) - own).max() for turn in turns]
        assert min(off) > 0.1
