"""Heated objects: in one piece, with the source on their surface."""

import equinox as eqx
import jax
import numpy as np
import pytest
from solids import check_fills_its_box, mesh_of

from jaxnbv.checks import InputError
from jaxnbv.studies.scenes import HEAT_OBJECTS, heat_scene

distances = eqx.filter_jit(lambda solid, x: solid(x))


def test_objects_are_in_one_piece_of_longest_side_two_and_a_half():
    for index, name in enumerate(HEAT_OBJECTS):
        scene = heat_scene(index)
        assert scene.name == heat_scene(index + len(HEAT_OBJECTS)).name == name
        mesh = mesh_of(scene.surface.sdf)
        assert mesh.body_count == 1
        check_fills_its_box(mesh)


def test_the_source_lies_on_a_level_face_in_the_open():
    up = {"desk": 1.0, "chair": 1.0, "mug": -1.0, "fins": -1.0}
    angle = np.linspace(0, 2 * np.pi, 12)
    rim = 0.05 * np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=-1)
    for index in range(8 * len(HEAT_OBJECTS)):
        scene = heat_scene(index)
        above = [[0.0, 0.05 * up[scene.name], 0.0]]
        distance = distances(scene.surface.sdf, np.asarray(scene.source) + np.concatenate([0 * rim[:1], rim, above]))
        np.testing.assert_allclose(distance, [0.0] * 13 + [0.05], atol=1e-5)


def test_scenes_differ_and_are_the_same_each_time():
    scenes = [heat_scene(index) for index in range(12)]
    assert len({tuple(np.asarray(scene.source).round(5)) for scene in scenes}) == 12
    assert len({tuple(np.ravel(scene.surface.sdf.half_size).round(5)) for scene in scenes}) == 12
    for a, b in zip(jax.tree.leaves(heat_scene(7)), jax.tree.leaves(scenes[7]), strict=True):
        np.testing.assert_array_equal(a, b)
    with pytest.raises(InputError, match="number is -3"):
        heat_scene(-3)
