"""Procedural part-labelled objects: every part is visible, in its place, and connected to the rest."""

import equinox as eqx
import jax
import numpy as np
import pytest
import trimesh
from solids import check_fills_its_box, check_whole, mesh_of, thinnest

from jaxnbv.networks.categories import CATEGORIES, category_index
from jaxnbv.studies.scenes import PART_CATEGORIES, Split, part_scene

COMPUTES = True

labels_at = eqx.filter_jit(lambda solid, x: solid.part_labels(x))


def part_object(category, turn):
    return part_scene(Split.VALIDATION, PART_CATEGORIES.index(category) + turn * len(PART_CATEGORIES)).solid


def present(solid):
    return {int(label) for label in solid.labels if label >= 0}


@pytest.mark.parametrize("category", PART_CATEGORIES)
def test_objects_are_whole_fill_their_box_and_show_every_part(category):
    solid = part_object(category, 1)
    mesh = mesh_of(solid)
    check_whole(mesh)
    check_fills_its_box(mesh)
    assert min(thinnest(part_object(category, turn)) for turn in range(6)) >= 0.05
    points, _ = trimesh.sample.sample_surface(mesh, 6000, seed=0)
    labels, share = np.unique(np.asarray(labels_at(solid, points.astype(np.float32))), return_counts=True)
    assert set(labels.tolist()) == present(solid) <= set(CATEGORIES[category_index(category)].labels)
    assert share.min() >= 0.015 * 6000
    assert len(labels) >= 2


def test_there_are_variants_with_and_without_optional_parts():
    for category, part in (("chair", 15), ("table", 49), ("earphone", 18), ("lamp", 26)):
        solids = [part_object(category, turn) for turn in range(16)]
        assert 0 < sum(part in present(solid) for solid in solids) < 16
        assert len({int((solid.labels >= 0).sum()) for solid in solids}) > 1


def parameters(solid):
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(solid)])


def test_categories_take_turns_and_no_two_scenes_are_the_same_in_any_split():
    count, scenes = 2 * len(PART_CATEGORIES), []
    for split in Split:
        for index in range(count):
            scene = part_scene(split, index)
            assert CATEGORIES[int(scene.category)].name == PART_CATEGORIES[index % len(PART_CATEGORIES)]
            assert set(np.flatnonzero(scene.parts).tolist()) == present(scene.solid)
            scenes.append(parameters(scene.solid))
    assert len(np.unique(np.stack(scenes).round(4), axis=0)) == 3 * count
    np.testing.assert_array_equal(parameters(part_scene(Split.TEST, count - 1).solid), scenes[-1])
