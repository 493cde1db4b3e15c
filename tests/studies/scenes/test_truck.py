"""A truck and the cargo on its bed."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from solids import check_fills_its_box, mesh_of

import jaxnbv as nbv
from jaxnbv.studies.scenes import Split, truck_scene

COMPUTES = True
CAMERA = nbv.Camera(height=40, width=40)

distances = eqx.filter_jit(lambda solid, x: solid(x))


@eqx.filter_jit
def cargo_pixels(scene, poses):
    clouds = nbv.scan(nbv.SDFSurface(scene), CAMERA, poses)
    return jnp.sum(scene.on_cue(clouds.points) & clouds.mask, axis=-1), jnp.sum(clouds.mask, axis=-1)


def alone(scene, wanted):
    """The primitives with these labels."""
    labels = jnp.where(wanted(scene.solid.labels), scene.solid.labels, -1)
    return eqx.tree_at(lambda solid: solid.labels, scene.solid, labels)


def up_of(scene):
    """The vertical of the truck: its first primitive is the floor of the bed, an upright box."""
    return np.asarray(scene.solid.rotation[0][:, 1])


# A bathtub, a desk and a table: low and wide, high and hollow, round or square. All cargo is placed by its bounds.
@pytest.mark.parametrize("label", [0, 3, 8])
def test_the_cargo_stands_on_the_bed_and_within_its_walls(label):
    scene = truck_scene(Split.VALIDATION, label)
    check_fills_its_box(mesh_of(scene))
    own = np.asarray(scene.solid.rotation[0]).T
    truck, vertices = alone(scene, lambda of: of == 0), mesh_of(alone(scene, lambda of: of > 0)).vertices
    cargo, floor = vertices @ own.T, np.asarray(scene.solid.centre[0]) @ own.T
    half = np.asarray(scene.solid.half_size[0])
    assert cargo[:, 1].min() == pytest.approx(floor[1] + half[1], abs=0.02)
    for axis in (0, 2):
        assert np.all(np.abs(cargo[:, axis] - floor[axis]) < half[axis])
    assert distances(truck, vertices.astype(np.float32)).min() > -0.01


def test_the_cargo_shows_from_above_alone():
    for index in range(6):
        scene = truck_scene(Split.VALIDATION, index)
        up, side = up_of(scene), np.asarray(scene.solid.rotation[0][:, 2])
        poses = nbv.look_at(2.5 * np.stack([up, -up, 0.95 * side - 0.3 * up]), up=side + 0.3 * up)
        pixels, clouds = cargo_pixels(scene, poses)
        assert 40 <= pixels[0] < 0.5 * clouds[0]
        assert pixels[1] == 0
        assert pixels[2] < 0.1 * clouds[2]


def test_scenes_take_turns_are_the_same_each_time_and_differ_between_splits():
    scenes = [truck_scene(split, index) for split in (Split.TRAIN, Split.TEST) for index in (3, 13, 3)]
    assert {int(scene.label) for scene in scenes} == {3}
    sizes = [tuple(np.ravel(scene.solid.half_size)) for scene in scenes]
    assert sizes[0] == sizes[2]
    assert len(set(sizes)) == 4
    # The vertical takes any direction.
    mean = np.mean([up_of(truck_scene(Split.TRAIN, index)) for index in range(60)], axis=0)
    assert np.linalg.norm(mean) < 0.35  # the mean of 60 uniform directions is that long with a chance of 6e-5
