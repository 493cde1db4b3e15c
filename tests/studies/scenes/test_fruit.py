"""Fruits: whole, bounded, in their box, and what each class shows."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from solids import check_fills_its_box, check_whole, mesh_of

from jaxnbv.checks import InputError
from jaxnbv.studies.scenes import FRUITS, Split, fruit_scene, sample_fruit

COMPUTES = True


@eqx.filter_jit
def slopes(fruit, x):
    return jnp.linalg.norm(jax.vmap(jax.grad(fruit))(x), axis=-1)


@functools.cache
def fruit_and_mesh(seed, label):
    fruit = sample_fruit(jax.random.key(seed), label)
    return fruit, mesh_of(fruit)


@pytest.mark.parametrize("label", range(len(FRUITS)))
def test_fruits_are_whole_fill_their_box_and_have_slopes_of_at_most_one(label):
    for seed in range(3):
        fruit, mesh = fruit_and_mesh(seed, label)
        check_whole(mesh)
        check_fills_its_box(mesh)
        anywhere = np.random.default_rng(seed).uniform(-1.6, 1.6, (20_000, 3))
        near = mesh.vertices[:: max(1, len(mesh.vertices) // 10_000)]
        x = np.concatenate([anywhere, near]).astype(np.float32)
        assert slopes(fruit, x).max() <= 1.0 + 1e-4


def own(fruit, mesh):
    """The vertices in the fruit's own frame, its axis y, a body's half height about 1."""
    return (mesh.vertices - np.asarray(fruit.offset)) @ np.asarray(fruit.rotation) / float(fruit.scale)


def test_each_class_has_its_marks():
    """In the fruit's own frame, of sections and of how far the surface reaches along the axis."""
    for seed in range(4):
        apple, lemon, mango, mushroom, orange = (own(*fruit_and_mesh(seed, label)) for label in range(5))

        def rim(points, low, high):
            away = np.linalg.norm(points[:, [0, 2]], axis=1)
            return points[(away > low) & (away < high)]

        # A stem rises out of a dimple; the other side is hollow too.
        above = apple[apple[:, 1] > 0]
        ring = rim(above, 0.1, 0.16)
        assert ring[:, 1].min() < rim(above, 0.4, 0.7)[:, 1].max() - 0.05
        assert rim(above, 0.0, 0.1)[:, 1].max() > ring[:, 1].min() + 0.1
        # Tips beyond an ellipsoid of half height 1.
        assert lemon[:, 1].max() > 1.1
        assert np.ptp(mango[:, 0]) < 0.8 * np.ptp(mango[:, 1])
        # The cap is wider than the stalk that stands below it.
        below, cap = (mushroom[mask] for mask in (mushroom[:, 1] < -0.3, mushroom[:, 1] > 0.3))
        assert np.linalg.norm(below[:, [0, 2]], axis=1).max() < 0.6 * np.linalg.norm(cap[:, [0, 2]], axis=1).max()
        # Round, and rough with pores.
        radius = np.linalg.norm(orange / [np.abs(orange[:, 0]).max(), 1.0, np.abs(orange[:, 2]).max()], axis=1)
        middle = radius[np.abs(orange[:, 1]) < 0.5]
        assert 0.003 < middle.std() < 0.05


def test_scenes_take_turns_are_the_same_each_time_and_differ_between_splits():
    fruits = [fruit_scene(split, index) for split in (Split.TRAIN, Split.TEST) for index in (3, 8, 3)]
    assert {int(fruit.label) for fruit in fruits} == {3}
    widths = [float(fruit.numbers["width"]) for fruit in fruits]
    assert widths[0] == widths[2]
    assert len({*widths}) == 4


def test_what_does_not_exist_is_refused():
    with pytest.raises(InputError, match="-1"):
        fruit_scene(Split.TEST, -1)
    with pytest.raises(InputError, match="longest side is 0"):
        sample_fruit(jax.random.key(0), 1, 0.0)
